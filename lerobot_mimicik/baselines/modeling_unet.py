"""The UNet diffusion baseline: an action drawn from noise in ten DDPM steps."""

import torch
from torch import Tensor, nn

from lerobot_mimicik.baselines.configuration_unet import UNetConfig
from lerobot_mimicik.baselines.unet import ConditionalUNet
from lerobot_mimicik.modeling_learned import LearnedIKPolicy
from lerobot_mimicik.objective import Objective, squared_norm


class Diffusion(Objective[ConditionalUNet]):
    """Denoising diffusion (Ho et al. 2020): the network learns the noise; inference removes it step by step.

    The schedule and both directions are those of diffusers. Its DDPM scheduler draws its own noise, so
    ancestral sampling is written as the stochastic case (eta = 1) of its DDIM scheduler, which is the same
    (Song et al. 2021) and takes noise that belongs to a sample.

    Args:
        train_timesteps: Noise levels in training.
        inference_steps: How many of them inference visits.

    Raises:
        ImportError: If diffusers is not installed.
    """

    name = "diffusion"
    random = True

    def __init__(self, train_timesteps: int = 100, inference_steps: int = 10):
        try:
            from diffusers.schedulers.scheduling_ddim import DDIMScheduler
        except ImportError as error:
            raise ImportError(
                "policies of type 'mimicik_unet' need diffusers: pip install 'lerobot_policy_mimicik[bench]'"
            ) from error
        self.draws = inference_steps
        self.train_timesteps = train_timesteps
        # Actions are normalised to [-1, 1], the range to which the scheduler clips.
        self.scheduler = DDIMScheduler(train_timesteps, beta_schedule="squaredcos_cap_v2", clip_sample=True)
        self.scheduler.set_timesteps(inference_steps)

    def loss(
        self, network: ConditionalUNet, obs: Tensor, action: Tensor, noise: Tensor, time: Tensor
    ) -> Tensor:
        noise = noise[:, : action.shape[-1]]
        step = (time * self.train_timesteps).long().clamp(max=self.train_timesteps - 1)
        noisy = self.scheduler.add_noise(action, noise, step)
        return squared_norm(network(noisy.unsqueeze(1), step, obs).squeeze(1) - noise)

    def predict(self, network: ConditionalUNet, obs: Tensor, noise: Tensor) -> Tensor:
        x, *fresh = noise.chunk(self.draws, dim=-1)
        # The last step adds no noise.
        for step, added in zip(self.scheduler.timesteps, [*fresh, torch.zeros_like(x)], strict=True):
            level = step.expand(len(x)).to(x.device)
            predicted = network(x.unsqueeze(1), level, obs).squeeze(1)
            x = self.scheduler.step(
                predicted, step, x, eta=1.0, use_clipped_model_output=True, variance_noise=added
            ).prev_sample
        return x


class UNetPolicy(LearnedIKPolicy):
    """The paper's diffusion baseline; see `LearnedIKPolicy` for what it does.

    Args:
        config: See `UNetConfig`.
        dataset_stats, dataset_meta: As for `LearnedIKPolicy`.
    """

    config_class = UNetConfig
    name = "mimicik_unet"
    config: UNetConfig

    def build(self) -> tuple[nn.Module, Objective]:
        """A conditional UNet under denoising diffusion."""
        config = self.config
        network = ConditionalUNet(
            config.n_obs_steps * self.conditioning.dim,
            config.dof,
            channels=config.channels,
            kernel_size=config.kernel_size,
            n_groups=config.n_groups,
            condition_dim=config.condition_dim,
        )
        return network, Diffusion(config.train_timesteps, config.inference_steps)
