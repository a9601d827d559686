"""The same inflation for MOOSE, the engine of the paper: an input file and its mesh, and a run where MOOSE is there.

The input is the paper's model in MOOSE's total Lagrangian system: ``ComputeNeoHookeanStress`` on
``ComputeLagrangianStrain``, ``Pressure`` on the displaced mesh, plane strain, load steps in time from 0 to 1. MOOSE
stops at our times whatever it does in between: ``TimeSequenceStepper`` halves a load step that fails, where a constant
``dt`` would lose step with us. ``stabilize_strain`` is on for ``"stabilised"``, our copy of it
(:mod:`inflate_lib.alternatives.stabilised`), and for mean dilatation, its relative, whose digits differ a little; it is
off for plain Q1.

The files are checked by reading them back; they have not been run with MOOSE in this project.
"""

import os
import shutil
import signal
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from inflate_lib._checks import choice, positive_number
from inflate_lib._files import check_outputs, hand_out, hand_out_folder, naming
from inflate_lib.io import _exodus
from inflate_lib.mechanics.inflation import LAMBDA, MAX_HALVINGS, MU, PRESSURE, check_lame, load_history

if TYPE_CHECKING:
    from inflate_lib.mechanics.inflation import Inflation
    from inflate_lib.mechanics.mesh import Mesh

#: Programs that contain MOOSE's solid mechanics, in the order in which they are looked for.
_PROGRAMS = ("solid_mechanics-opt", "combined-opt")

_INPUT = """\
# Inflation of a soft structure: plane strain, neo-Hookean, pressure that follows the wall.
# Lengths in sides of the unit square that the image fills. Run: solid_mechanics-opt -i {name}.i

[GlobalParams]
  displacements = 'disp_x disp_y'
  large_kinematics = true
  stabilize_strain = {stabilize}
[]

[Mesh]
  [wall]
    type = FileMeshGenerator
    file = {name}.e
  []
[]

[Variables]
  [disp_x]
  []
  [disp_y]
  []
[]

[Kernels]
  [stress_x]
    type = TotalLagrangianStressDivergence
    variable = disp_x
    component = 0
  []
  [stress_y]
    type = TotalLagrangianStressDivergence
    variable = disp_y
    component = 1
  []
[]

[Materials]
  [strain]
    type = ComputeLagrangianStrain
  []
{materials}
[]

[Functions]
  [inflation]
    type = PiecewiseLinear
    x = '0 {times}'
    y = '0 {pressures}'
  []
[]

[BCs]
  [clamped_x]
    type = DirichletBC
    variable = disp_x
    boundary = {clamped}
    value = 0
  []
  [clamped_y]
    type = DirichletBC
    variable = disp_y
    boundary = {clamped}
    value = 0
  []
  [Pressure]
    [inside]
      boundary = {cavity}
      function = inflation
      use_displaced_mesh = true
    []
  []
[]

[Preconditioning]
  [full]
    type = SMP
    full = true
  []
[]

[Executioner]
  type = Transient
  solve_type = NEWTON
  petsc_options_iname = '-pc_type'
  petsc_options_value = 'lu'
  line_search = none
  automatic_scaling = true
  nl_rel_tol = 1e-10
  nl_abs_tol = 1e-12
  nl_max_its = 40
  start_time = 0
  end_time = 1
  dtmin = {dtmin!r}
  [TimeStepper]
    type = TimeSequenceStepper
    time_sequence = '{times}'
  []
[]

[Outputs]
  [exodus]
    type = Exodus
    file_base = {name}_out
  []
[]
"""


_MATERIAL = """\
  [{name}]
    type = ComputeNeoHookeanStress
    lambda = {lam!r}
    mu = {mu!r}
  []"""

_STABILIZE = {"mean-dilatation": "true", "q1": "false", "stabilised": "true"}


def _input_text(
    name, n_steps=None, element="mean-dilatation", pressure=PRESSURE, lame=(LAMBDA, MU), rubbers=(("wall", 1.0),)
):
    """The MOOSE input for the mesh ``name.e``; the other parameters are those of :func:`inflate_lib.inflate`.

    `rubbers` are the blocks of the mesh, each with what λ and μ are multiplied by.
    """
    choice("element", element, _STABILIZE)
    lam, mu = check_lame(lame)
    times, pressures = load_history(pressure, n_steps)
    return _INPUT.format(
        name=name, stabilize=_STABILIZE[element], materials=_materials(rubbers, lam, mu),
        times=_words(times), pressures=_words(pressures), dtmin=float(times[0]) / 2**MAX_HALVINGS,
        cavity=_exodus.CAVITY, clamped=_exodus.CLAMPED,
    )  # fmt: skip


def _materials(rubbers, lam, mu):
    """The stress of each block."""
    if len(rubbers) == 1:
        return _MATERIAL.format(name="stress", lam=lam * rubbers[0][1], mu=mu * rubbers[0][1])
    texts = []
    for block, stiffness in rubbers:
        text = _MATERIAL.format(name=f"stress_{block}", lam=lam * stiffness, mu=mu * stiffness)
        texts.append(text.replace("Stress\n", f"Stress\n    block = {block}\n"))
    return "\n".join(texts)


def write_case(mesh: "Mesh", folder: str | Path, name: str = "inflation", **parameters: Any) -> list[Path]:
    """Write ``name.i`` and ``name.e`` into a folder: a block and a material for each rubber of the wall.

    Parameters
    ----------
    mesh : Mesh
    folder : path_like
        Made where it is missing.
    name : str
        Letters, digits, dots, hyphens and underscores.
    parameters
        ``n_steps``, ``element``, ``pressure``, ``lame``, as :func:`inflate_lib.inflate` takes them.

    Returns
    -------
    list of Path
        The input file and the mesh.

    Raises
    ------
    ValueError
        For a name that MOOSE's input syntax would not take for one word.
    OSError
        Where a file cannot be written, or would replace one that is not as this library wrote it; none is left behind
        then.
    """
    if not name or not all(c.isalnum() or c in "._-" for c in name):
        raise ValueError(f"name: {name!r} must consist of letters, digits, dots, hyphens and underscores")
    rubbers = [(block, stiffness) for block, stiffness, _ in _exodus.blocks(mesh)]
    text, files = _input_text(name, rubbers=rubbers, **parameters), case_files(folder, name)[:2]
    with hand_out_folder(folder) as place:
        with naming(files[0]):
            (place / f"{name}.i").write_text(text, encoding="utf-8")
        with naming(files[1]):
            _exodus.write_mesh(mesh, place / f"{name}.e")
    return files


def case_files(folder, name):
    """The input, the mesh, and the results that a run of MOOSE writes."""
    return [Path(folder) / file for file in (f"{name}.i", f"{name}.e", f"{name}_out.e")]


def find_program():
    """Path of a MOOSE program, or a RuntimeError that says which are looked for."""
    for name in _PROGRAMS:
        if found := shutil.which(name):
            return found
    raise RuntimeError(f"MOOSE is not here: neither {' nor '.join(_PROGRAMS)} is on the PATH")


def run_case(result: "Inflation", input_file: str | Path, time_limit: float = 600.0) -> "Inflation":
    """Run a case and return what MOOSE found as an :class:`Inflation`.

    Parameters
    ----------
    result : Inflation
        Our result of the same case; it lends mesh, load steps and parameters.
    input_file : path_like
        From :func:`write_case`.
    time_limit : float
        Seconds.

    Returns
    -------
    Inflation
        With MOOSE's displacements; stresses that are asked of it are evaluated with our element. ``factorisations`` is
        0. ``converged`` is False, with MOOSE's last line as the reason, where a load step is missing.

    Raises
    ------
    RuntimeError
        Where there is no MOOSE, or it wrote no results in time; what it started is ended with it.
    ValueError
        Where what it wrote is not what Exodus results of this mesh look like.
    OSError
        Where its results cannot be written beside the input, or would replace a file that is not of an earlier run.
    """
    positive_number("time_limit", time_limit, "seconds")
    input_file = Path(input_file)
    case, mesh, output = case_files(input_file.parent, input_file.stem)
    command = [find_program(), "-i", case.name]
    check_outputs([output])
    with tempfile.TemporaryDirectory() as folder:  # so that no older run passes for this one, nor half of this one
        for file in (case, mesh):
            shutil.copy(file, folder)
        code, said = _run(command, folder, time_limit)
        found = Path(folder, output.name)
        if not found.exists():
            raise RuntimeError(f"MOOSE wrote no results for {case.name} (exit code {code}): {said}")
        with hand_out(output) as place:
            shutil.copy(found, place)
    times, found = _exodus.read_displacement(output, result.nodes)
    displacement = np.full(result.displacement.shape, np.nan)
    for step, time in enumerate(result.load_steps):
        at = np.flatnonzero(np.abs(times - time) < 1e-9)  # MOOSE may have cut a load step into more
        if not at.size or not np.isfinite(found[at[-1]]).all():
            break
        displacement[step] = found[at[-1]]
    reached = int(np.isfinite(displacement).all(axis=(1, 2)).sum())
    converged = reached == len(result.load_steps)
    reason = "" if converged else f"MOOSE reached load step {reached} of {len(result.load_steps)}: {said}"
    return replace(result, displacement=displacement, converged=converged, reason=reason, factorisations=0)


def _run(command, folder, time_limit):
    """Exit code and last line of a program that runs in a folder."""
    with subprocess.Popen(
        command, cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        text=True, errors="replace", start_new_session=True,
    ) as process:  # fmt: skip
        try:
            text, _ = process.communicate(timeout=time_limit)
        except BaseException as error:  # out of time, or interrupted
            os.killpg(process.pid, signal.SIGKILL)  # MOOSE may be a script that started the program proper
            if not isinstance(error, subprocess.TimeoutExpired):
                raise
            raise RuntimeError(f"MOOSE did not finish {command[-1]} within {time_limit:g} s") from None
    return process.returncode, ([line.strip() for line in text.splitlines() if line.strip()] or ["nothing"])[-1]


def _words(numbers):
    """Numbers as MOOSE reads them in quotes, with every digit."""
    return " ".join(repr(float(number)) for number in numbers)
