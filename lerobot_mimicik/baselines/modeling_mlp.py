"""The pure MLP baseline: one feed-forward pass from the observations to the joint step."""

from itertools import pairwise

from torch import Tensor, nn

from lerobot_mimicik.baselines.configuration_mlp import MLPConfig
from lerobot_mimicik.modeling_learned import LearnedIKPolicy
from lerobot_mimicik.objective import Objective, squared_norm


class FeedForward(nn.Module):
    """MLP from a flattened observation history to an action.

    Args:
        obs_dim: Numbers in the history T_o * n.
        action_dim: Width of an action n_a.
        hidden_dim: Width of the hidden layers.
        n_layers: Number of the hidden layers.
    """

    def __init__(self, obs_dim: int, action_dim: int, hidden_dim: int = 512, n_layers: int = 4):
        super().__init__()
        widths = [obs_dim, *[hidden_dim] * n_layers]
        hidden = [
            layer for before, after in pairwise(widths) for layer in (nn.Linear(before, after), nn.GELU())
        ]
        self.layers = nn.Sequential(*hidden, nn.Linear(hidden_dim, action_dim))

    def forward(self, obs: Tensor) -> Tensor:
        """Normalised observations, shape (B, T_o, n), to normalised actions, shape (B, n_a)."""
        return self.layers(obs.flatten(1))


class DirectRegression(Objective[FeedForward]):
    """Squared error of the network's one answer."""

    name = "regression"

    def loss(self, network: FeedForward, obs: Tensor, action: Tensor, noise: Tensor, time: Tensor) -> Tensor:
        return squared_norm(network(obs) - action)

    def predict(self, network: FeedForward, obs: Tensor, noise: Tensor) -> Tensor:
        return network(obs)


class MLPPolicy(LearnedIKPolicy):
    """The paper's regression baseline; see `LearnedIKPolicy` for what it does.

    Args:
        config: See `MLPConfig`.
        dataset_stats, dataset_meta: As for `LearnedIKPolicy`.
    """

    config_class = MLPConfig
    name = "mimicik_mlp"
    config: MLPConfig

    def build(self) -> tuple[nn.Module, Objective]:
        """An MLP under a squared error."""
        config = self.config
        network = FeedForward(
            config.n_obs_steps * self.conditioning.dim, config.dof, config.hidden_dim, config.n_layers
        )
        return network, DirectRegression()
