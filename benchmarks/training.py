"""Training and sampling against peers: U-Nets of the paper's widths, in batches of 100, interleaved in one run.

    pip install diffusers denoising-diffusion-pytorch
    python benchmarks/training.py --repeats 5

writes data/reference/speed_training.csv, and speed_training.json, which says where it comes from. The peers are the
U-Nets that most readers would take: diffusers' ``UNet2DModel`` (one layer per block; attention in the middle, as it
always has) and ``Unet`` of lucidrains' denoising_diffusion_pytorch (with its own attention at every scale). All get the
same batches, loss and optimiser. Ours is timed with attention, too. The descriptor enters ours and that of diffusers
through the same small network; the third is told the time alone, which saves it work.

A training step is forward, backward and Adam; a sampling step is one evaluation and one ancestral step. Peak memory is
that of two training steps in a process of its own, beyond what the process held before the network was made.

On a GPU every network runs in float32, in bfloat16 and compiled, and `--side-by-side 5` trains that many at once.
"""

import os
import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from importlib import import_module
from multiprocessing import get_context
from typing import Annotated

import numpy as np
import pandas as pd
import torch
import typer
from stored import machine, store
from torch import nn

from inflate_lib.diffusion import TrainingConfig, UNet, cosine_schedule, process
from inflate_lib.diffusion.sampling import ancestral_step

SCHEDULE = cosine_schedule(1000)
PEERS = {  # module and package
    "diffusers": ("diffusers", "diffusers"),
    "lucidrains": ("denoising_diffusion_pytorch", "denoising-diffusion-pytorch"),
}


class Diffusers(nn.Module):
    """diffusers' U-Net with our descriptor network, whose answer it adds to the embedding of the time."""

    def __init__(self, channels):
        from diffusers import UNet2DModel

        super().__init__()
        embedding = 4 * channels[0]  # what diffusers makes it; 256 for the paper's widths
        self.descriptor = UNet(1, channels, embedding).descriptor
        self.net = UNet2DModel(
            sample_size=28,
            in_channels=1,
            out_channels=1,
            layers_per_block=1,
            block_out_channels=tuple(channels),
            down_block_types=("DownBlock2D",) * len(channels),
            up_block_types=("UpBlock2D",) * len(channels),
            norm_num_groups=min(32, channels[0]),
            class_embed_type="identity",
        )

    def forward(self, x, t, y):
        return self.net(x, t, class_labels=self.descriptor(y)).sample


class Lucidrains(nn.Module):
    """lucidrains' U-Net as it comes."""

    def __init__(self, channels):
        from denoising_diffusion_pytorch import Unet

        super().__init__()
        self.net = Unet(dim=channels[0], dim_mults=tuple(c // channels[0] for c in channels), channels=1)

    def forward(self, x, t, y):
        return self.net(x, t)


NETS = {
    "inflate_lib": lambda channels: UNet(1, channels),
    "inflate_lib, attention": lambda channels: UNet(1, channels, attention=True),
    "diffusers": Diffusers,
    "lucidrains": Lucidrains,
}


class Bench:
    """A network with its optimiser and a batch, ready to be timed."""

    def __init__(self, name, channels, batch, device, precision="float32", compiled=False):
        torch.manual_seed(0)
        self.device, self.bfloat16 = torch.device(device), precision == "bfloat16"
        self.net = NETS[name](channels).to(self.device).to(memory_format=torch.channels_last)
        on_gpu = self.device.type == "cuda"
        self.optimiser = torch.optim.Adam(self.net.parameters(), lr=TrainingConfig(steps=1).learning_rate, fused=on_gpu)
        self.predict = torch.compile(self.net) if compiled else self.net
        self.x0 = torch.rand(batch, 1, 28, 28, device=self.device) * 2 - 1
        self.noise = torch.randn_like(self.x0)
        self.t = torch.randint(1000, (batch,))
        self.t_there, self.y = self.t.to(self.device), torch.rand(batch, 1, device=self.device)
        self.x = process.add_noise(SCHEDULE, self.x0, self.t, self.noise)

    def answer(self):
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bfloat16):
            return self.predict(self.x, self.t_there, self.y)

    def training_step(self):
        self.net.train()
        self.optimiser.zero_grad()
        process.squared_error(self.answer().float(), self.noise).mean().backward()
        self.optimiser.step()

    def sampling_step(self):
        self.net.eval()
        with torch.inference_mode():
            x0 = process.predicted_x0(SCHEDULE, self.x, self.t, self.answer().float(), "epsilon").clamp(-1, 1)
            ancestral_step(SCHEDULE, x0, self.x, self.t, self.noise)

    def seconds(self, step, times=1):
        """Per step; on a GPU, whose steps are short, over several."""
        self.synchronise()
        start = time.perf_counter()
        for _ in range(times):
            step()
        self.synchronise()
        return (time.perf_counter() - start) / times

    def synchronise(self):
        if self.device.type == "cuda":
            torch.cuda.synchronize()


def peak_memory(setting):
    """Megabytes at the peak of two training steps."""
    if setting[3] == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        bench = Bench(*setting)
        for _ in range(2):
            bench.training_step()
        return (torch.cuda.max_memory_allocated() - before) / 1e6
    Bench("inflate_lib", (8, 16), 2, "cpu").training_step()  # what PyTorch loads with its first step is not counted
    import_peers(setting[0])
    unit = 1 if sys.platform == "darwin" else 1024
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    bench = Bench(*setting)
    for _ in range(2):
        bench.training_step()
    return (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * unit / 1e6


def meet(barrier):
    """Give a process the barrier at which all wait until the last one has compiled."""
    global together
    together = barrier


def throughput(setting, seconds=5.0):
    """Training steps per second, for some seconds, the same for all processes."""
    bench = Bench(*setting)
    for _ in range(3):
        bench.training_step()
    bench.synchronise()
    together.wait(1200)
    start, n = time.perf_counter(), 0
    while time.perf_counter() - start < seconds:
        bench.seconds(bench.training_step, 10)
        n += 10
    return n / (time.perf_counter() - start)


def import_peers(*names):
    """Import what the networks come from; say what to install where it is not there."""
    for name in set(names) & set(PEERS):
        module, package = PEERS[name]
        try:
            import_module(module)
        except ImportError as error:
            sys.exit(f"{name} cannot be imported ({error}): pip install {package}, or leave it out with --nets")


def main(
    nets: Annotated[str, typer.Option(help="Names, with a semicolon between them.")] = ";".join(NETS),
    channels: Annotated[str, typer.Option(help="Of the U-Nets.")] = "64,128,256",
    batch: Annotated[int, typer.Option(help="Images in a batch.")] = 100,
    repeats: Annotated[int, typer.Option(help="Rounds; the median counts.")] = 5,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cuda" if torch.cuda.is_available() else "cpu",
    compiled: Annotated[bool, typer.Option("--compile", help="Compiled networks, too (always on a GPU).")] = False,
    side_by_side: Annotated[int, typer.Option(help="Also train so many of ours at once, in processes.")] = 0,
):
    """Time the networks, one after the other in each round."""
    names, widths, on_gpu = nets.split(";"), tuple(map(int, channels.split(","))), device == "cuda"
    import_peers(*names)
    load = round(os.getloadavg()[0], 1)
    kinds = [("float32", False)] + [("bfloat16", False)] * on_gpu + [("bfloat16", True)] * on_gpu
    kinds += [("float32", True)] * (compiled and not on_gpu)
    settings = [(name, widths, batch, device, *kind) for kind in kinds for name in names]
    with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as alone:
        memory = [alone.submit(peak_memory, setting).result() for setting in settings]
    benches, times = [Bench(*setting) for setting in settings], 20 if on_gpu else 1
    steps = [(bench, step) for bench in benches for step in (bench.training_step, bench.sampling_step)]
    for bench, step in steps:  # warm, and compiled, before the clock starts
        bench.seconds(step, 2)
    seconds = np.array([[bench.seconds(step, times) for bench, step in steps] for _ in range(repeats)])
    training, sampling = np.median(seconds, axis=0).reshape(-1, 2).T
    rows = pd.DataFrame(settings, columns=["net", "channels", "batch", "device", "precision", "compiled"])
    rows["channels"] = channels.replace(",", "/")
    rows["parameters"] = [sum(p.numel() for p in bench.net.parameters()) for bench in benches]
    rows["training_step_s"], rows["sampling_step_s"], rows["images_per_s"] = training, sampling, batch / training
    rows["peak_memory_mb"] = memory
    for column in ("training_step_s", "sampling_step_s", "peak_memory_mb"):  # to ours in the same arithmetic
        ours = rows.groupby(["precision", "compiled"])[column].transform("first")
        rows[column.removesuffix("_s").removesuffix("_mb") + "_ratio"] = rows[column] / ours
    if side_by_side:
        setting = settings[-len(names)]
        spawn = get_context("spawn")
        with ProcessPoolExecutor(side_by_side, spawn, meet, (spawn.Barrier(side_by_side),)) as pool:
            rate = sum(pool.map(throughput, [setting] * side_by_side))
        row = rows.iloc[-len(names)][["channels", "batch", "device", "precision", "compiled", "parameters"]].to_dict()
        row |= {"net": f"{names[0]}, {side_by_side} at once", "images_per_s": rate * batch}
        rows = pd.concat([rows, pd.DataFrame([row])], ignore_index=True)
    store(
        rows,
        "speed_training",
        "training.py",
        repeats=repeats,
        device=torch.cuda.get_device_name() if on_gpu else machine()["processor"],
        threads=torch.get_num_threads(),
        load_before=load,  # more than a little above 0: others were at work, and only the ratios mean something
    )


if __name__ == "__main__":
    typer.run(main)
