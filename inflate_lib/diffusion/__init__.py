"""Conditional denoising diffusion (section 2 of the paper). Needs PyTorch, NumPy and safetensors only.

The modules follow the paper: ``schedule`` and ``process`` (sections 2.1, 2.2), ``unet`` and ``training`` (section 4.1),
``sampling`` (section 2.3). ``config``, ``model`` and ``storage`` hold what a run is made of and the files it leaves.
"""

from inflate_lib.diffusion.config import TrainingConfig
from inflate_lib.diffusion.model import TrainedModel
from inflate_lib.diffusion.sampling import generate
from inflate_lib.diffusion.schedule import Schedule, cosine_schedule, linear_schedule
from inflate_lib.diffusion.training import train
from inflate_lib.diffusion.unet import UNet

__all__ = [
    "Schedule",
    "TrainedModel",
    "TrainingConfig",
    "UNet",
    "cosine_schedule",
    "generate",
    "linear_schedule",
    "train",
]
