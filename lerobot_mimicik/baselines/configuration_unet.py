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

    def check(self) -> None:
        """As `LearnedIKConfig.check`."""
        super().check()
        self.check_sizes(train_timesteps=10_000, inference_steps=10_000, kernel_size=63, n_groups=1024)
        if self.inference_steps > self.train_timesteps:
            raise ValueError(
                f"inference_steps={self.inference_steps}: expected at most "
                f"train_timesteps={self.train_timesteps}"
            )
        if not 1 <= len(self.channels) <= 16 or any(
            not 1 <= width <= 8192 or width % self.n_groups for width in self.channels
        ):
            raise ValueError(
                f"channels={self.channels}: expected 1 to 16 multiples of n_groups={self.n_groups}, up to 8192"
            )
        if self.kernel_size % 2 == 0:
            raise ValueError(f"kernel_size={self.kernel_size}: expected an odd number")
        if not 4 <= self.condition_dim <= 8192 or self.condition_dim % 2:
            raise ValueError(f"condition_dim={self.condition_dim}: expected an even number from 4 to 8192")
