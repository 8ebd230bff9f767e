"""The optimiser as the FK consistency pass shares it: finding it, and stepping it once more.

LeRobot builds the optimiser and never shows it to the policy, and its loop has one backward pass a step.
The paper's second pass (own `zero_grad`, own backward, own step of the same AdamW) therefore runs in the
policy's `update()` hook, with the optimiser that was seen stepping the policy's weights.
"""

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.optim import Optimizer
from torch.optim.optimizer import register_optimizer_step_post_hook


class SharedOptimiser:
    """Learns which optimiser trains the given parameters, and makes extra steps with it."""

    def __init__(self, parameters: Iterable[nn.Parameter]):
        self._parameters = list(parameters)
        self._optimiser: Optimizer | None = None
        self._hook: Any = None

    def watch(self) -> None:
        """Starts looking out for the optimiser's first step; does nothing once it is known."""
        if self._optimiser is None and self._hook is None:
            self._hook = register_optimizer_step_post_hook(self._see_step)

    def _see_step(self, optimiser: Optimizer, args: Any, kwargs: Any) -> None:
        stepped = {id(p) for group in optimiser.param_groups for p in group["params"]}
        if self._optimiser is None and id(self._parameters[0]) in stepped:
            self._optimiser = optimiser
            self._hook.remove()
            self._hook = None

    def step(self, loss: Callable[[], Tensor], max_norm: float) -> tuple[Tensor, Tensor]:
        """One forward-backward pass of its own and one optimiser step.

        Gradients are averaged over processes by hand, since the pass runs outside the forward of
        DistributedDataParallel, which would otherwise do it.

        Args:
            loss: Computes the loss to descend, a scalar.
            max_norm: Gradients are clipped to this norm; zero leaves them as they are.

        Returns:
            The loss and the gradient norm before clipping, detached scalars.

        Raises:
            RuntimeError: If no optimiser has stepped these parameters yet.
        """
        if self._optimiser is None:
            raise RuntimeError(
                "no optimiser step on this policy's weights has been seen: call optimizer.step() between "
                "forward() and update(), or train with fk_update=joint"
            )
        self._optimiser.zero_grad()
        value = loss()
        value.backward()
        _average_over_processes(self._parameters)
        norm = nn.utils.clip_grad_norm_(self._parameters, max_norm if max_norm > 0 else float("inf"))
        self._optimiser.step()
        self._optimiser.zero_grad()
        return value.detach(), norm.detach()

    def __getstate__(self) -> dict[str, Any]:
        # Copies of a policy (and other processes) have optimisers of their own.
        return {"_parameters": self._parameters, "_optimiser": None, "_hook": None}


def _average_over_processes(parameters: list[nn.Parameter]) -> None:
    if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        return
    gradients = [p.grad for p in parameters if p.grad is not None]
    flat = torch.cat([g.flatten() for g in gradients])
    torch.distributed.all_reduce(flat)
    flat /= torch.distributed.get_world_size()
    for gradient, mean in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
        gradient.copy_(mean.view_as(gradient))
