"""SuDeepDiT, the conditional flow generator of MimicIK, and the MLP that encodes its observations.

    o (B, T_o, n) ──ObservationEncoder──> (B, T_o, d) ──flatten, MLP──┐
    s, t (B,) ──two sinusoidal embeddings, d/2 each─────────────── (+)──> condition c (B, d)
                                                                      │
                       c ──> encoder block 1 ──> ... ──> encoder block N      (post-norm)
                                  │ e_1                       │ e_N
    x (B, T_a, n_a) ──linear, + position──> decoder block 1 ──> ... ──> decoder block N ──> final ──> f
                                            modulated by e_1 + c        by e_N + c         by c

The paper gives sizes and two parameter counts (16.2 M for the flow map, 0.2 M for the encoder), which
pin what its text leaves open: a feed-forward width of 4 d (the 8 d of its table would give 24 M).
"""

import math

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn


class ObservationEncoder(nn.Module):
    """MLP from a flattened observation history to one token of width `d_model` a frame."""

    def __init__(self, n_obs_steps: int, obs_dim: int, d_model: int):
        super().__init__()
        self.n_obs_steps = n_obs_steps
        self.d_model = d_model
        self.layers = nn.Sequential(
            nn.Linear(n_obs_steps * obs_dim, d_model),
            nn.GELU(),
            nn.Linear(d_model, d_model),
            nn.GELU(),
            nn.Linear(d_model, n_obs_steps * d_model),
        )

    def forward(self, obs: Tensor) -> Tensor:
        """Encodes normalised observations, shape (B, T_o, n), as tokens, shape (B, T_o, d)."""
        return self.layers(obs.flatten(1)).unflatten(1, (self.n_obs_steps, self.d_model))


class SelfAttention(nn.Module):
    """Multi-head self-attention."""

    def __init__(self, d_model: int, n_heads: int):
        super().__init__()
        self.n_heads = n_heads
        self.query_key = nn.Linear(d_model, 2 * d_model)
        self.value = nn.Linear(d_model, d_model)
        self.out = nn.Linear(d_model, d_model)

    def forward(self, x: Tensor) -> Tensor:
        """Maps tokens to tokens, shape (B, T, d)."""
        value = self.value(x)
        if x.shape[1] > 1:  # attention over a single token is the identity on its value
            query, key = self.query_key(x).chunk(2, dim=-1)
            heads = [y.unflatten(-1, (self.n_heads, -1)).transpose(1, 2) for y in (query, key, value)]
            value = F.scaled_dot_product_attention(*heads).transpose(1, 2).flatten(2)
        return self.out(value)


def _feed_forward(d_model: int, d_ff: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(d_model, d_ff), nn.GELU(), nn.Linear(d_ff, d_model))


class EncoderBlock(nn.Module):
    """Post-norm Transformer block over the condition token."""

    def __init__(self, d_model: int, n_heads: int, d_ff: int):
        super().__init__()
        self.attention = SelfAttention(d_model, n_heads)
        self.norm_attention = nn.LayerNorm(d_model)
        self.feed_forward = _feed_forward(d_model, d_ff)
        self.norm_feed_forward = nn.LayerNorm(d_model)

    def forward(self, x: Tensor) -> Tensor:
        """Maps tokens to tokens, shape (B, T, d)."""
        x = self.norm_attention(x + self.attention(x))
        return self.norm_feed_forward(x + self.feed_forward(x))


def _zero_initialised(linear: nn.Linear) -> nn.Linear:
    nn.init.zeros_(linear.weight)
    nn.init.zeros_(linear.bias)
    return linear


def _modulate(x: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
    return x * (1 + scale.unsqueeze(1)) + shift.unsqueeze(1)


class DecoderBlock(nn.Module):
    """DiT block: adaptive layer norm before attention and MLP, zero-initialised gates after them."""

    def __init__(self, d_model: int, n_heads: int, d_ff: int):
        super().__init__()
        self.norm_attention = nn.LayerNorm(d_model, elementwise_affine=False)
        self.attention = SelfAttention(d_model, n_heads)
        self.norm_feed_forward = nn.LayerNorm(d_model, elementwise_affine=False)
        self.feed_forward = _feed_forward(d_model, d_ff)
        self.modulation = nn.Sequential(nn.SiLU(), _zero_initialised(nn.Linear(d_model, 6 * d_model)))

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """Maps action tokens, shape (B, T_a, d), given a condition, shape (B, d)."""
        shift_a, scale_a, gate_a, shift_f, scale_f, gate_f = self.modulation(condition).chunk(6, dim=-1)
        attended = self.attention(_modulate(self.norm_attention(x), shift_a, scale_a))
        x = x + gate_a.unsqueeze(1) * attended
        fed = self.feed_forward(_modulate(self.norm_feed_forward(x), shift_f, scale_f))
        return x + gate_f.unsqueeze(1) * fed


class FinalLayer(nn.Module):
    """Modulated linear read-out; zero-initialised, so that an untrained network answers zero."""

    def __init__(self, d_model: int, action_dim: int):
        super().__init__()
        self.norm = nn.LayerNorm(d_model, elementwise_affine=False)
        self.modulation = nn.Sequential(nn.SiLU(), _zero_initialised(nn.Linear(d_model, 2 * d_model)))
        self.linear = _zero_initialised(nn.Linear(d_model, action_dim))

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """Maps action tokens, shape (B, T_a, d), to actions, shape (B, T_a, n_a)."""
        shift, scale = self.modulation(condition).chunk(2, dim=-1)
        return self.linear(_modulate(self.norm(x), shift, scale))


class SuDeepDiT(nn.Module):
    """Symmetric encoder-decoder Transformer f(x, s, t | o).

    Args:
        obs_tokens: Number of observation tokens T_o.
        action_dim: Width of an action n_a.
        horizon: Number of action tokens T_a.
        d_model: Hidden width d; even, and a multiple of `n_heads`.
        n_layers: Blocks in the encoder, and as many in the decoder.
        n_heads: Attention heads.
        d_ff: Feed-forward width.
    """

    frequencies: Tensor

    def __init__(
        self,
        obs_tokens: int,
        action_dim: int,
        *,
        horizon: int = 1,
        d_model: int = 256,
        n_layers: int = 8,
        n_heads: int = 4,
        d_ff: int = 1024,
    ):
        super().__init__()
        self.project_condition = nn.Sequential(
            nn.Linear(obs_tokens * d_model, d_model), nn.GELU(), nn.Linear(d_model, d_model)
        )
        self.project_action = nn.Linear(action_dim, d_model)
        self.position = nn.Parameter(0.02 * torch.randn(1, horizon, d_model))
        self.encoder = nn.ModuleList(EncoderBlock(d_model, n_heads, d_ff) for _ in range(n_layers))
        self.decoder = nn.ModuleList(DecoderBlock(d_model, n_heads, d_ff) for _ in range(n_layers))
        self.final = FinalLayer(d_model, action_dim)
        half = d_model // 4  # a sine and a cosine for each of the two times: d/4 frequencies
        frequencies = torch.exp(-math.log(10_000.0) * torch.arange(half) / max(half - 1, 1))
        # Times lie in [0, 1]; the usual factor spreads them over the embedding's frequencies.
        self.register_buffer("frequencies", 1000.0 * frequencies, persistent=False)

    def _embed(self, time: Tensor) -> Tensor:
        phase = time[:, None] * self.frequencies
        return torch.cat([phase.sin(), phase.cos()], dim=-1)

    def forward(self, x: Tensor, s: Tensor, t: Tensor, obs_tokens: Tensor) -> Tensor:
        """Evaluates the flow map.

        Args:
            x: Normalised (noisy) action, shape (B, T_a, n_a).
            s: Source flow time in [0, 1], shape (B,).
            t: Target flow time in [0, 1], shape (B,).
            obs_tokens: Encoded observations, shape (B, T_o, d).

        Returns:
            The network's answer (an action or a velocity: the objective says which), shape (B, T_a, n_a).
        """
        times = torch.cat([self._embed(s), self._embed(t)], dim=-1)
        condition = self.project_condition(obs_tokens.flatten(1)) + times
        x = self.project_action(x) + self.position
        token = condition.unsqueeze(1)
        for encode, decode in zip(self.encoder, self.decoder, strict=True):
            token = encode(token)
            x = decode(x, token.squeeze(1) + condition)
        return self.final(x, condition)


class FlowGenerator(nn.Module):
    """Observation encoder and flow map: what is trained, averaged (EMA) and deployed as one."""

    def __init__(self, encoder: ObservationEncoder, flow_map: SuDeepDiT):
        super().__init__()
        self.encoder = encoder
        self.flow_map = flow_map

    def encode(self, obs: Tensor) -> Tensor:
        """Observation tokens, shape (B, T_o, d), of normalised observations, shape (B, T_o, n)."""
        return self.encoder(obs)

    def forward(self, x: Tensor, s: float | Tensor, t: float | Tensor, obs_tokens: Tensor) -> Tensor:
        """f(x, s, t | o) for one action token: x and the answer have shape (B, n_a); s, t are numbers or (B,)."""
        times = [torch.as_tensor(time, dtype=x.dtype, device=x.device).expand(x.shape[0]) for time in (s, t)]
        return self.flow_map(x.unsqueeze(1), *times, obs_tokens).squeeze(1)
