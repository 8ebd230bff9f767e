"""Configuration of the pure MLP baseline: the sizes of its network."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from lerobot_mimicik.configuration_learned import LearnedIKConfig


@PreTrainedConfig.register_subclass("mimicik_mlp")
@dataclass
class MLPConfig(LearnedIKConfig):
    """The paper's regression baseline, "a deterministic 1-step feed-forward network".

    The paper gives no sizes. Its latency, a hundredth of a Transformer's, leaves room for a few layers;
    these make about as many weights as the small MimicIK recipe has.
    """

    # The paper's baseline has no FK consistency loss.
    fk_weight: float = 0.0

    # --- The network. ---
    # Width and number of the hidden layers.
    hidden_dim: int = 512
    n_layers: int = 4

    def check(self) -> None:
        """As `LearnedIKConfig.check`."""
        super().check()
        self.check_sizes(hidden_dim=65_536, n_layers=256)
