"""Configuration of the UNet diffusion baseline: its diffusion and the sizes of its network."""

from dataclasses import dataclass, field

from lerobot.configs import PreTrainedConfig

from lerobot_mimicik.configuration_learned import LearnedIKConfig


@PreTrainedConfig.register_subclass("mimicik_unet")
@dataclass
class UNetConfig(LearnedIKConfig):
    """The paper's generative baseline, "a standard 10-step DDPM-based diffusion policy" with a UNet.

    The paper gives no sizes and no schedule: the schedule is that of Diffusion Policy (100 noise levels,
    squared cosine, noise prediction, clipped samples), and the sizes make about as many weights as
    MimicIK has.
    """

    # The paper's baseline has no FK consistency loss.
    fk_weight: float = 0.0

    # --- The diffusion. ---
    # Noise levels in training, and how many of them inference visits.
    train_timesteps: int = 100
    inference_steps: int = 10

    # --- The network (conditional 1-D UNet). ---
    # Channels of each resolution, from the finest.
    channels: list[int] = field(default_factory=lambda: [128, 256, 512])
    kernel_size: int = 3
    # Groups of channels that are normalised together.
    n_groups: int = 8
    # Width of the embedded time and of the encoded observations, each.
    condition_dim: int = 128

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_at_least_one("train_timesteps", "inference_steps", "kernel_size", "n_groups")
        if self.inference_steps > self.train_timesteps:
            raise ValueError(
                f"inference_steps={self.inference_steps}: expected at most "
                f"train_timesteps={self.train_timesteps}"
            )
        if not self.channels or any(width < 1 or width % self.n_groups for width in self.channels):
            raise ValueError(f"channels={self.channels}: expected multiples of n_groups={self.n_groups}")
        if self.kernel_size % 2 == 0:
            raise ValueError(f"kernel_size={self.kernel_size}: expected an odd number")
        if self.condition_dim < 4 or self.condition_dim % 2:
            raise ValueError(f"condition_dim={self.condition_dim}: expected an even number of at least 4")
