"""Configuration of the foresight policy: history, tremor, closed-loop rounds and the sizes of its network."""

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from lerobot_mimicik.configuration_learned import LearnedIKConfig

_SHORTEST_HISTORY = 5  # targets; fewer show no tremor


@PreTrainedConfig.register_subclass("mimicik_foresight")
@dataclass
class ForesightConfig(LearnedIKConfig):
    """Everything a foresight checkpoint needs to be used again; see `LearnedIKConfig` for what it shares."""

    # Targets that the network sees, the present one included: 0.7 s at 20 Hz.
    n_obs_steps: int = 14
    # Pull to the forward kinematics of what should be done; regression needs none.
    fk_weight: float = 0.0
    ema_decay: float = 0.99

    objective: str = "regression"
    # MIP's second time t*, and Euler steps of the flow objective.
    t_star: float = 0.9
    flow_steps: int = 10

    # Weight of the squared error of the step's change against that of the step.
    change_weight: float = 1.0

    # --- The hand in training. ---
    # Largest tremor of the targets, root mean square of the translation in mm, with half a degree per mm, and the
    # fraction of motion without any.
    tremor_mm: float = 2.2
    steady: float = 0.2
    # Largest factor by which recorded motion is made faster.
    pace: float = 1.0
    # Largest root mean square of joint velocity that is added to recorded motion [rad/s]: generated hands are too calm.
    liveliness: float = 0.0

    # --- Closed-loop rounds. ---
    # Training steps between rollouts of the policy, and frames of each.
    rollout_every: int = 500
    rollout_frames: int = 40_000

    # --- The network. ---
    # Width and number of the hidden layers.
    hidden_dim: int = 192
    n_layers: int = 3

    # --- Training. ---
    optimizer_lr: float = 2e-3

    def check(self) -> None:
        """As `LearnedIKConfig.check`."""
        super().check()
        self.check_choice("objective", ("regression", "mip", "flow"))
        self.check_sizes(
            flow_steps=1000, hidden_dim=8192, n_layers=64, rollout_every=10**9, rollout_frames=10**7
        )
        self.check_share("t_star")
        self.check_share("steady")
        for name in ("change_weight", "tremor_mm", "liveliness"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name}={getattr(self, name)}: expected zero or more")
        if not 1 <= self.pace <= 10:
            raise ValueError(f"pace={self.pace}: expected 1 to 10")
        if self.n_obs_steps < _SHORTEST_HISTORY:
            raise ValueError(f"n_obs_steps={self.n_obs_steps}: expected at least {_SHORTEST_HISTORY}")
