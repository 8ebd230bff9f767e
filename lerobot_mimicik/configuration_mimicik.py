"""Configuration of the MimicIK policy: its objective and the sizes of its network."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from lerobot_mimicik.configuration_learned import LearnedIKConfig


@PreTrainedConfig.register_subclass("mimicik")
@dataclass
class MimicIKConfig(LearnedIKConfig):
    """Everything a MimicIK checkpoint needs to be used again; see `LearnedIKConfig` for what it shares."""

    objective: str = "mip"
    # MIP's second time t*.
    t_star: float = 0.9
    # Euler steps of the flow objective.
    flow_steps: int = 10

    # --- The network (SuDeepDiT). ---
    d_model: int = 256
    n_layers: int = 8
    n_heads: int = 4
    d_ff: int = 1024

    def check(self) -> None:
        """As `LearnedIKConfig.check`."""
        super().check()
        self.check_choice("objective", ("mip", "flow", "regression"))
        self.check_sizes(flow_steps=1000, d_model=8192, n_layers=256, n_heads=256, d_ff=65_536)
        if self.d_model % (4 * self.n_heads):
            raise ValueError(f"d_model={self.d_model} must be a multiple of 4 * n_heads = {4 * self.n_heads}")
        self.check_share("t_star")
