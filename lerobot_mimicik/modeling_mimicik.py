"""The MimicIK policy: a small flow generator, refined once, kept on the arm's forward kinematics."""

from lerobot_mimicik.configuration_mimicik import MimicIKConfig
from lerobot_mimicik.modeling_learned import LearnedIKPolicy
from lerobot_mimicik.network import FlowGenerator, ObservationEncoder, SuDeepDiT
from lerobot_mimicik.objective import OBJECTIVES, Objective


class MimicIKPolicy(LearnedIKPolicy):
    """Generative inverse kinematics as a LeRobot policy; see `LearnedIKPolicy` for what it does.

    Args:
        config: See `MimicIKConfig`.
        dataset_stats, dataset_meta: As for `LearnedIKPolicy`.
    """

    config_class = MimicIKConfig
    name = "mimicik"
    config: MimicIKConfig
    network: FlowGenerator

    def build(self) -> tuple[FlowGenerator, Objective]:
        """SuDeepDiT behind its observation encoder, under the configured objective."""
        config = self.config
        network = FlowGenerator(
            ObservationEncoder(config.n_obs_steps, self.conditioning.dim, config.d_model),
            SuDeepDiT(
                config.n_obs_steps,
                config.dof,
                d_model=config.d_model,
                n_layers=config.n_layers,
                n_heads=config.n_heads,
                d_ff=config.d_ff,
            ),
        )
        return network, OBJECTIVES[config.objective](config)
