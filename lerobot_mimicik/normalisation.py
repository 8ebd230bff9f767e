"""Min-max normalisation to [-1, 1] whose bounds travel with the checkpoint."""

import torch
from torch import Tensor, nn


class MinMax(nn.Module):
    """Linear map of each dimension's training range to [-1, 1].

    The bounds are buffers: they are saved with the weights, and loading a checkpoint needs no dataset.
    A dimension that never moved in training is only shifted, by its value.
    """

    lower: Tensor
    upper: Tensor

    def __init__(self, dim: int):
        super().__init__()
        self.register_buffer("lower", torch.full((dim,), -1.0))
        self.register_buffer("upper", torch.full((dim,), 1.0))

    def fit(self, lower: Tensor, upper: Tensor) -> None:
        """Sets the bounds, shape (dim,).

        Raises:
            ValueError: If a bound has another shape, is not finite, or lies on the wrong side.
        """
        for name, bound in (("lower", lower), ("upper", upper)):
            if bound.shape != self.lower.shape:
                raise ValueError(
                    f"{name} bound: expected shape {tuple(self.lower.shape)}, got {tuple(bound.shape)}"
                )
            if not torch.isfinite(bound).all():
                raise ValueError(f"{name} bound is not finite: {bound.tolist()}")
        if (lower > upper).any():
            raise ValueError(f"lower bounds {lower.tolist()} exceed upper bounds {upper.tolist()}")
        self.lower.copy_(lower)
        self.upper.copy_(upper)

    def _centre_and_half_range(self) -> tuple[Tensor, Tensor]:
        half = (self.upper - self.lower) / 2
        return (self.upper + self.lower) / 2, torch.where(half > 1e-6, half, torch.ones_like(half))

    def normalise(self, x: Tensor) -> Tensor:
        """Physical to normalised, shape (*, dim)."""
        centre, half = self._centre_and_half_range()
        return (x - centre) / half

    def unnormalise(self, x: Tensor) -> Tensor:
        """Normalised to physical, shape (*, dim)."""
        centre, half = self._centre_and_half_range()
        return x * half + centre
