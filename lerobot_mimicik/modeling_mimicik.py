"""The MimicIK policy: a small flow generator, refined once, kept on the arm's forward kinematics."""

from pathlib import Path
from typing import Any

from huggingface_hub import CommitInfo, ModelCard
from lerobot.datasets import LeRobotDatasetMetadata

from lerobot_mimicik.configuration_mimicik import MimicIKConfig
from lerobot_mimicik.modeling_learned import LearnedIKPolicy
from lerobot_mimicik.network import FlowGenerator, ObservationEncoder, SuDeepDiT
from lerobot_mimicik.objective import OBJECTIVES, Objective
from lerobot_mimicik.publishing.hub import card_after_training, push_policy


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
    # Where the policy was loaded from: what lies beside the weights there goes along to the Hub.
    _source: str | None = None

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

    # --- The Hub ---

    @classmethod
    def from_pretrained(cls, pretrained_name_or_path: str | Path, **options: Any) -> "MimicIKPolicy":
        """Loads a checkpoint from a folder or a Hub repository, with LeRobot's options.

        Raises:
            FileNotFoundError: If there is no checkpoint.
            TypeError: If it is one of another policy.
        """
        policy = super().from_pretrained(pretrained_name_or_path, **options)
        policy._source = str(pretrained_name_or_path)
        return policy

    def generate_model_card(
        self,
        dataset_repo_id: str,
        model_type: str,
        license: str | None,
        tags: list[str] | None,
        cfg: Any = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
    ) -> ModelCard:
        """The card that LeRobot uploads at the end of training."""
        return card_after_training(self, dataset_repo_id, license, tags, cfg, dataset_meta)

    def push_to_hub(self, repo_id: str, **options: Any) -> CommitInfo:
        """Uploads the policy, its processors, its card and its evaluation: see `.hub.push_policy`.

        What lies beside the weights is taken from where the policy was loaded, unless `source` says otherwise.
        """
        return push_policy(self, repo_id, **({"source": self._source} | options))
