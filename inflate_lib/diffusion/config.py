"""Everything that determines a training run, apart from the data."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields

from inflate_lib.diffusion._random import initialised
from inflate_lib.diffusion.process import check_objective
from inflate_lib.diffusion.unet import UNet, check_conditioning

_ASIDE = ("device", "precision", "compile", "checkpoint_every", "log_every")


@dataclass(frozen=True)
class TrainingConfig:
    """Choices of a training run. Defaults are the paper's (section 4.1).

    Exactly one of ``steps`` and ``epochs`` gives the budget, and ``checkpoint_every`` counts in the same unit.
    """

    channels: tuple[int, ...] = (64, 128, 256)  # of the U-Net at each scale, finest first
    embedding: int = 256  # width of the context vector ζ
    hidden: int = 200  # width of the two hidden layers of the descriptor network
    blocks: int = 1  # residual blocks per scale, on the way down and on the way up
    conditioning: str = "scale-shift"  # how ζ enters a residual block; or "add"
    attention: bool = False  # self-attention on the coarsest grid
    objective: str = "epsilon"  # what the network predicts: "epsilon" (paper) or "v"
    vlb_weight: float = 0.001  # λ of the hybrid loss
    min_snr: float = 0.0  # γ of min-SNR weighting (Hang et al. 2023 take 5); 0: the plain L_simple
    timestep_draws: int = 1  # of so many uniform draws of t the noisiest trains; 1: uniform (paper), 2: density ∝ t
    condition_dropout: float = 0.1  # share of the structures whose descriptor is withheld
    parts: tuple[int, ...] = ()  # lengths of the parts of a descriptor that can be asked for separately; (): it is one
    steps: int | None = None
    epochs: int | None = None
    batch_size: int = 100
    learning_rate: float = 1e-4
    learning_rate_decay: str = "constant"  # or "cosine": down to zero at the end of the budget
    warmup_steps: int = 0  # steps over which the learning rate grows to its value
    ema_decay: float = 0.0  # of the running average of the weights, which is what is kept; 0: none
    T: int = 1000  # diffusion steps of the cosine schedule
    seed: int = 0
    checkpoint_every: int | None = None  # None: 10 epochs (paper), or a twentieth of a budget given in steps
    log_every: int = 50  # steps that each entry of the history averages
    device: str = "auto"  # "auto" (CUDA, then MPS, then CPU) or a torch device
    precision: str = "auto"  # of the network's arithmetic: "float32", "bfloat16", or "auto": bfloat16 on CUDA alone
    compile: bool = False  # torch.compile: worth its minute of preparation on a GPU

    def __post_init__(self):
        if not isinstance(self.channels, list | tuple) or not self.channels:
            raise ValueError(f"channels must be a list with the channels of each scale, not {self.channels!r}")
        object.__setattr__(self, "channels", tuple(self.channels))
        if not isinstance(self.parts, list | tuple):
            raise ValueError(f"parts must be a list with the length of each part of the descriptor, not {self.parts!r}")
        object.__setattr__(self, "parts", tuple(self.parts))
        check_objective(self.objective)
        check_conditioning(self.conditioning)
        if (self.steps is None) == (self.epochs is None):
            raise ValueError("give the training budget as exactly one of steps and epochs")
        if self.learning_rate_decay not in ("constant", "cosine"):
            raise ValueError(f"learning_rate_decay is constant or cosine, not {self.learning_rate_decay!r}")
        if self.precision not in ("auto", "float32", "bfloat16"):
            raise ValueError(f"precision is auto, float32 or bfloat16, not {self.precision!r}")
        whole = {f.name: getattr(self, f.name) for f in fields(self) if f.type in (int, int | None)}
        whole |= {f"channels[{i}]": c for i, c in enumerate(self.channels)}
        whole |= {f"parts[{i}]": c for i, c in enumerate(self.parts)}
        for name, value in whole.items():
            least = 0 if name in ("seed", "warmup_steps") else 1
            if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < least):
                raise ValueError(f"{name} must be a whole number of at least {least}, not {value!r}")
        if self.embedding % 2:
            raise ValueError(f"embedding must be even (cosines and sines), not {self.embedding}")
        ends = {"condition_dropout": 1, "ema_decay": 1, "vlb_weight": math.inf, "min_snr": math.inf}
        ends |= {"learning_rate": math.inf}
        for name, end in ends.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < end:
                raise ValueError(
                    f"{name} must be a number of at least 0 and less than {end}, not {value!r}"
                    + " (YAML reads 1e-3 as text: write 1.0e-3)" * isinstance(value, str)
                )
        for name in ("attention", "compile"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} must be true or false, not {getattr(self, name)!r}")

    def training_steps(self, n: int) -> int:
        """Training steps in all, on n pairs."""
        return self.steps if self.steps is not None else self.epochs * math.ceil(n / self.batch_size)

    def checkpoint_steps(self, n: int) -> int:
        """Training steps between two checkpoints, on n pairs."""
        if self.steps is not None:
            return self.checkpoint_every or math.ceil(self.steps / 20)
        return (self.checkpoint_every or 10) * math.ceil(n / self.batch_size)

    def as_dict(self) -> dict:
        """Plain values, ready for JSON."""
        return asdict(self) | {"channels": list(self.channels), "parts": list(self.parts)}

    def recipe(self) -> dict:
        """``as_dict`` without what only says where, how fast and how talkatively to compute, not what is learned."""
        return {name: value for name, value in self.as_dict().items() if name not in _ASIDE}

    @classmethod
    def from_dict(cls, values: Mapping) -> "TrainingConfig":
        """The reverse of ``as_dict``; an unknown name is a ValueError."""
        unknown = set(values) - {f.name for f in fields(cls)}
        if unknown:
            raise ValueError(f"unknown training options: {', '.join(sorted(unknown))}")
        return cls(**values)

    def make_net(self, n_conditions: int) -> UNet:
        """An untrained network; its weights follow from the seed."""
        widths = self.channels, self.embedding, self.hidden
        options = self.blocks, self.conditioning, self.attention
        return initialised(lambda: UNet(n_conditions, *widths, *options, parts=self.parts), self.seed)
