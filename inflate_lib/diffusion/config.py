"""Everything that determines a training run, apart from the data."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields

from inflate_lib._checks import choice, flag, number, whole_number
from inflate_lib.diffusion.process import OBJECTIVES
from inflate_lib.diffusion.randomness import initialised
from inflate_lib.diffusion.unet import CONDITIONINGS, UNet

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
    image_channels: int = 1  # of the images; more than one where an image says more than where the digit is
    objective: str = "epsilon"  # what the network predicts: "epsilon" (paper) or "v"
    vlb_weight: float = 0.001  # λ of the hybrid loss
    min_snr: float = 0.0  # γ of min-SNR weighting (Hang et al. 2023 take 5); 0: the plain L_simple
    timestep_draws: int = 1  # of so many uniform draws of t the noisiest trains; 1: uniform (paper), 2: density ∝ t
    condition_dropout: float = 0.1  # share of the structures whose descriptor is withheld
    parts: tuple[int, ...] = ()  # lengths of the parts of a descriptor that can be asked for separately; (): it is one
    strongest: float = 0.0  # of a student: the largest strength of guidance that was distilled into it
    distillation_steps: int = 2500  # of a student
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
        if not isinstance(self.parts, list | tuple):
            raise ValueError(f"parts must be a list with the length of each part of the descriptor, not {self.parts!r}")
        choice("objective", self.objective, OBJECTIVES)
        choice("conditioning", self.conditioning, CONDITIONINGS)
        if (self.steps is None) == (self.epochs is None):
            raise ValueError("give the training budget as exactly one of steps and epochs")
        choice("learning_rate_decay", self.learning_rate_decay, ("constant", "cosine"))
        choice("precision", self.precision, ("auto", "float32", "bfloat16"))
        plain = {
            name: tuple(whole_number(f"{name}[{i}]", value, 1) for i, value in enumerate(getattr(self, name)))
            for name in ("channels", "parts")
        }
        for name in (f.name for f in fields(self) if f.type in (int, int | None)):
            if getattr(self, name) is not None:
                plain[name] = whole_number(name, getattr(self, name), 0 if name in ("seed", "warmup_steps") else 1)
        for name in (f.name for f in fields(self) if f.type is float):
            below = 1 if name in ("condition_dropout", "ema_decay") else math.inf
            plain[name] = number(name, getattr(self, name), least=0, below=below)
        for name, value in plain.items():
            object.__setattr__(self, name, value)
        if self.embedding % 2:
            raise ValueError(f"embedding must be even (cosines and sines), not {self.embedding}")
        flag("attention", self.attention)
        flag("compile", self.compile)

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
        known = [f.name for f in fields(cls)]
        if unknown := [name for name in values if name not in known]:
            raise ValueError(f"unknown training options: {', '.join(unknown)}; there are: {', '.join(known)}")
        return cls(**values)

    def make_net(self, n_conditions: int) -> UNet:
        """An untrained network; its weights follow from the seed."""
        widths = self.channels, self.embedding, self.hidden
        options = self.blocks, self.conditioning, self.attention
        told = {"parts": self.parts, "told_guidance": self.strongest > 0, "image_channels": self.image_channels}
        return initialised(lambda: UNet(n_conditions, *widths, *options, **told), self.seed)
