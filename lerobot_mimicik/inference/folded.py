"""The flow generator at the few times that its inference visits, by exact algebra: fewer operations, the same function.

- The condition depends on the observation and two times, which are known beforehand; the encoder and every modulation
  depend on the condition alone. They are computed once, for all times as rows of one batch, so that their weights are
  read once.
- Attention over one token is linear: value and output are one matrix, and in the encoder the residual is added to it.
- Two linear maps in a row, with nothing in between, are one: the last one of the observation encoder and the first one of
  the condition.

Products of weights are made in double precision, so that rounding is all that remains between this and the plain network.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

from lerobot_mimicik.network import DecoderBlock, EncoderBlock, FlowGenerator, SelfAttention


class FoldedGenerator(nn.Module):
    """Answers as the `FlowGenerator` that it is made from, at `times` only; for objectives' `predict`."""

    times_embedded: Tensor

    def __init__(self, network: FlowGenerator, times: Sequence[tuple[float, float]]):
        """
        Args:
            network: Whose weights at construction time are taken; it answers one action token.
            times: All (s, t) that it will be asked for.
        """
        super().__init__()
        self._rows = {pair: row for row, pair in enumerate(times)}
        flow: Any = network.flow_map  # nn.Module does not say what its containers hold
        first, second = list(network.encoder.layers), list(flow.project_condition)
        self.observe = nn.Sequential(
            *first[:-1], _product(_linear(second[0]), _linear(first[-1])), *second[1:]
        )
        self.encoder = nn.ModuleList(_FoldedEncoder(block) for block in flow.encoder)
        self.decoder = nn.ModuleList(_FoldedDecoder(block) for block in flow.decoder)
        self.modulate = nn.ModuleList(
            _scales_from_one(_linear(block.modulation[1]), 6) for block in flow.decoder
        )
        self.modulate_final = _scales_from_one(_linear(flow.final.modulation[1]), 2)
        self.project, self.final = _copy(flow.project_action), _copy(flow.final.linear)
        with torch.no_grad():
            self.project.bias.add_(flow.position[0, 0])
        moments = torch.tensor(list(times), dtype=flow.frequencies.dtype, device=flow.frequencies.device)
        embedded = torch.cat([flow._embed(moments[:, 0]), flow._embed(moments[:, 1])], dim=-1)
        self.register_buffer("times_embedded", embedded[:, None])

    def encode(self, obs: Tensor) -> list[Tensor]:
        """Modulations of the decoder's blocks and of the read-out, each (times * B, n), of observations (B, T_o, n)."""
        # Two axes throughout: exporters would reshape around every product of three.
        condition = (self.observe(obs.flatten(1)) + self.times_embedded).flatten(0, 1)
        token, found = condition, []
        for encode, modulate in zip(self.encoder, self.modulate, strict=True):
            token = encode(token)
            found.append(modulate(F.silu(token + condition)))
        return [*found, self.modulate_final(F.silu(condition))]

    def forward(self, x: Tensor, s: float, t: float, modulations: list[Tensor]) -> Tensor:
        """f(x, s, t | o), shape (B, n_a), with the modulations of `encode`; KeyError for other times."""
        first = self._rows[s, t] * len(x)
        rows = slice(first, first + len(x))
        x = self.project(x)
        for decode, modulation in zip(self.decoder, modulations[:-1], strict=True):
            x = decode(x, modulation[rows])
        shift, scale = modulations[-1][rows].chunk(2, dim=-1)
        return self.final(torch.addcmul(shift, _norm(x), scale))


class _FoldedEncoder(nn.Module):
    """`EncoderBlock` for one token a row, (*, d)."""

    def __init__(self, block: EncoderBlock):
        super().__init__()
        self.attend = _attention(block.attention)
        with torch.no_grad():
            self.attend.weight.add_(torch.eye(len(self.attend.weight), device=self.attend.weight.device))
        self.norm_attention, self.norm_feed_forward = block.norm_attention, block.norm_feed_forward
        self.feed_forward = block.feed_forward

    def forward(self, token: Tensor) -> Tensor:
        token = self.norm_attention(self.attend(token))
        return self.norm_feed_forward(token + self.feed_forward(token))


class _FoldedDecoder(nn.Module):
    """`DecoderBlock` for one token a row, (B, d), with its modulation (B, 6 d), whose scales are counted from zero."""

    def __init__(self, block: DecoderBlock):
        super().__init__()
        self.attend, self.feed_forward = _attention(block.attention), block.feed_forward

    def forward(self, x: Tensor, modulation: Tensor) -> Tensor:
        shift_a, scale_a, gate_a, shift_f, scale_f, gate_f = modulation.chunk(6, dim=-1)
        x = torch.addcmul(x, gate_a, self.attend(torch.addcmul(shift_a, _norm(x), scale_a)))
        return torch.addcmul(x, gate_f, self.feed_forward(torch.addcmul(shift_f, _norm(x), scale_f)))


def _norm(x: Tensor) -> Tensor:
    return F.layer_norm(x, x.shape[-1:])


def _attention(attention: SelfAttention) -> nn.Linear:
    """Attention over a single token, which gives all its weight to it."""
    return _product(attention.out, attention.value)


def _scales_from_one(linear: nn.Linear, parts: int) -> nn.Linear:
    """The modulation's linear map with 1 added to its scales: the second of every two or three parts."""
    scaled = _copy(linear)
    with torch.no_grad():
        for bias in scaled.bias.chunk(parts)[1 :: 3 if parts == 6 else 2]:
            bias += 1.0
    return scaled


def _product(after: nn.Linear, before: nn.Linear) -> nn.Linear:
    """Two linear maps as one."""
    product = nn.Linear(
        before.in_features, after.out_features, device=after.weight.device, dtype=after.weight.dtype
    )
    with torch.no_grad():
        product.weight.copy_(after.weight.double() @ before.weight.double())
        product.bias.copy_(after.weight.double() @ before.bias.double() + after.bias.double())
    return product


def _linear(module: nn.Module) -> nn.Linear:
    assert isinstance(module, nn.Linear)
    return module


def _copy(linear: nn.Linear) -> nn.Linear:
    copied = nn.Linear(
        linear.in_features, linear.out_features, device=linear.weight.device, dtype=linear.weight.dtype
    )
    copied.load_state_dict(linear.state_dict())
    return copied
