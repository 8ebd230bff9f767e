"""The compiled core of guidance: one bounded least-squares problem over one frame or several.

Joints of T frames, X (T, n), minimise

    sum_t  |W e_t|^2                                  pose, with dead zones per axis
         + sum_j u_j^2 ( wv (x_t - x_{t-1})^2 + wa (x_t - 2 x_{t-1} + x_{t-2})^2 + wj (third difference)^2
                       + wn_t (x_t - prior_t)^2 + wp (x_t - posture)^2 )
         + wb sum_j h_j^2                             h: how far a joint is inside the margin of a limit, as a fraction
         + wc sum_p g_p^2                             g: how far a pair of spheres is inside the clearance, as a fraction

over the box of joint limits and of at most `max_step` from frame to frame, by Levenberg-Marquardt steps with an
active set. Everything is numba in nopython mode, compiled once per machine and then read from numba's cache; no
kernel allocates anything that outlives its call.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from lerobot_mimicik.guidance.bounded_newton import bounded_newton
from lerobot_mimicik.guidance.kinematics_kernels import (
    nearest_turn,
    point_jacobian,
    pose_difference,
    tool_pose,
    walk,
    weigh,
)

_jit = njit(cache=True, error_model="numpy")

# Order of the weights that the kernels take as one array.
VELOCITY, ACCELERATION, JERK, LIMITS, POSTURE, COLLISION = range(6)


@_jit
def keep_bounds(x, start, lower, upper, max_step):
    """Move every frame of `x` (T, n) into the limits and within a step of the frame before it."""
    frames, n = x.shape
    for t in range(frames):
        for j in range(n):
            before = start[j] if t == 0 else x[t - 1, j]
            low, high = max(lower[j], before - max_step[j]), min(upper[j], before + max_step[j])
            # Joints outside the limits come back by at most a step: the step is the stronger bound.
            low, high = min(low, before + max_step[j]), max(high, before - max_step[j])
            x[t, j] = min(max(x[t, j], low), high)


@_jit
def evaluate(x, past, arm, goal, costs, bounds, derivatives, buffers):
    """Cost of a plan; with `derivatives`, also its gradient -g/2 and Gauss-Newton matrix (lower triangle, h).

    Fills `residuals` (T, 6), the weighted pose residuals.
    """
    chain, spheres, pairs, unit = arm
    targets_rotation, targets_position, (weight, tolerance, tool_axes, axis) = goal
    weights, posture, prior, prior_weight, zone, extra = costs
    step_rotations, step_positions, columns, prismatic, tool_rotation, tool_position = chain
    centres, radii, bodies = spheres
    lower, upper, margin = bounds
    h, g, frames_rotation, frames_position, residuals = buffers
    frames, n = x.shape
    size = frames * n
    if derivatives:
        for i in range(size):
            g[i] = 0.0
            for k in range(i + 1):
                h[i, k] = 0.0
    rotation, position, nearest = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    error, row_scale = np.empty(6), np.empty(6)
    jacobian = np.empty((6, n))
    rows = np.empty((6, n))
    first, second = np.empty((3, n)), np.empty((3, n))
    cost = 0.0
    for t in range(frames):
        walk(x[t], step_rotations, step_positions, columns, prismatic, frames_rotation, frames_position)
        tool_pose(frames_rotation, frames_position, tool_rotation, tool_position, rotation, position)
        nearest_turn(rotation, targets_rotation[t], axis, nearest)
        pose_difference(rotation, position, nearest, targets_position[t], error)
        residual = residuals[t]
        weigh(error, targets_rotation[t], weight, tolerance, tool_axes, residual, row_scale)
        for k in range(6):
            cost += residual[k] * residual[k]
        base = t * n
        if derivatives:
            point_jacobian(frames_rotation, frames_position, columns, prismatic, n, position, jacobian[:3])
            for i in range(n):
                j = columns[i]
                for a in range(3):
                    jacobian[3 + a, j] = 0.0 if prismatic[i] else frames_rotation[i + 1, a, 2]
            for block in range(2):
                for a in range(3):
                    k = 3 * block + a
                    for j in range(n):
                        if tool_axes:
                            value = 0.0
                            for b in range(3):
                                value += targets_rotation[t, b, a] * jacobian[3 * block + b, j]
                        else:
                            value = jacobian[k, j]
                        rows[k, j] = row_scale[k] * value
            for j in range(n):
                value = 0.0
                for k in range(6):
                    value += rows[k, j] * residual[k]
                g[base + j] += value
                for i in range(j + 1):
                    value = 0.0
                    for k in range(6):
                        value += rows[k, j] * rows[k, i]
                    h[base + j, base + i] += value
        # Limits.
        for j in range(n):
            m = margin[j]
            if not m > 0.0:
                continue
            inside = 0.0
            if x[t, j] < lower[j] + m:
                inside = (lower[j] + m - x[t, j]) / m
            elif x[t, j] > upper[j] - m:
                inside = -(x[t, j] - (upper[j] - m)) / m
            if inside != 0.0:
                cost += weights[LIMITS] * inside * inside
                if derivatives:
                    g[base + j] += weights[LIMITS] * inside / m
                    h[base + j, base + j] += weights[LIMITS] / (m * m)
        # Self-collision.
        if len(pairs) and weights[COLLISION] > 0.0:
            for p in range(len(pairs)):
                a, b = pairs[p, 0], pairs[p, 1]
                ca, cb = centres[a], centres[b]
                ra, rb = frames_rotation[bodies[a]], frames_rotation[bodies[b]]
                pa, pb = frames_position[bodies[a]], frames_position[bodies[b]]
                d0 = (pa[0] + ra[0, 0] * ca[0] + ra[0, 1] * ca[1] + ra[0, 2] * ca[2]) - (
                    pb[0] + rb[0, 0] * cb[0] + rb[0, 1] * cb[1] + rb[0, 2] * cb[2]
                )
                d1 = (pa[1] + ra[1, 0] * ca[0] + ra[1, 1] * ca[1] + ra[1, 2] * ca[2]) - (
                    pb[1] + rb[1, 0] * cb[0] + rb[1, 1] * cb[1] + rb[1, 2] * cb[2]
                )
                d2 = (pa[2] + ra[2, 0] * ca[0] + ra[2, 1] * ca[1] + ra[2, 2] * ca[2]) - (
                    pb[2] + rb[2, 0] * cb[0] + rb[2, 1] * cb[1] + rb[2, 2] * cb[2]
                )
                near = radii[a] + radii[b] + zone[0]
                square = d0 * d0 + d1 * d1 + d2 * d2
                if square >= near * near:
                    continue
                distance = math.sqrt(square)
                gap = (near - distance) / zone[1]
                cost += weights[COLLISION] * gap * gap
                if derivatives and distance > 1e-9:
                    point = np.empty(3)
                    for k in range(3):
                        point[k] = pa[k] + ra[k, 0] * ca[0] + ra[k, 1] * ca[1] + ra[k, 2] * ca[2]
                    point_jacobian(
                        frames_rotation, frames_position, columns, prismatic, bodies[a], point, first
                    )
                    for k in range(3):
                        point[k] = pb[k] + rb[k, 0] * cb[0] + rb[k, 1] * cb[1] + rb[k, 2] * cb[2]
                    point_jacobian(
                        frames_rotation, frames_position, columns, prismatic, bodies[b], point, second
                    )
                    for j in range(n):
                        slope = (
                            d0 * (first[0, j] - second[0, j])
                            + d1 * (first[1, j] - second[1, j])
                            + d2 * (first[2, j] - second[2, j])
                        ) / (distance * zone[1])
                        g[base + j] += weights[COLLISION] * gap * slope
                        rows[0, j] = slope
                    for j in range(n):
                        for i in range(j + 1):
                            h[base + j, base + i] += weights[COLLISION] * rows[0, j] * rows[0, i]
        # What pulls joint by joint: velocity, acceleration, jerk, prior, posture.
        for j in range(n):
            uu = unit[j] * unit[j]
            x0 = x[t, j]
            x1 = x[t - 1, j] if t >= 1 else past[2, j]
            x2 = x[t - 2, j] if t >= 2 else past[t + 1, j]
            x3 = x[t - 3, j] if t >= 3 else past[t, j]
            v, a, jk = x0 - x1, x0 - 2.0 * x1 + x2, x0 - 3.0 * x1 + 3.0 * x2 - x3
            wv, wa, wj = uu * weights[VELOCITY], uu * weights[ACCELERATION], uu * weights[JERK]
            wn, wp = uu * prior_weight[t], uu * weights[POSTURE]
            dn, dp = x0 - prior[t, j], x0 - posture[j]
            cost += wv * v * v + wa * a * a + wj * jk * jk + wn * dn * dn + wp * dp * dp
            if not derivatives:
                continue
            i0 = base + j
            g[i0] -= wv * v + wa * a + wj * jk + wn * dn + wp * dp
            h[i0, i0] += wv + wa + wj + wn + wp
            if t >= 1:
                i1 = i0 - n
                g[i1] += wv * v + 2.0 * wa * a + 3.0 * wj * jk
                h[i1, i1] += wv + 4.0 * wa + 9.0 * wj
                h[i0, i1] -= wv + 2.0 * wa + 3.0 * wj
            if t >= 2:
                i2 = i0 - 2 * n
                g[i2] -= wa * a + 3.0 * wj * jk
                h[i2, i2] += wa + 9.0 * wj
                h[i0, i2] += wa + 3.0 * wj
                h[i0 - n, i2] -= 2.0 * wa + 9.0 * wj
            if t >= 3:
                i3 = i0 - 3 * n
                g[i3] += wj * jk
                h[i3, i3] += wj
                h[i0, i3] -= wj
                h[i0 - n, i3] += 3.0 * wj
                h[i0 - 2 * n, i3] -= 3.0 * wj
    extra_matrix, extra_slope, extra_reference = extra
    if len(extra_slope):
        # A user's terms as a quadratic about a reference: c - 2 s'(x - r) + (x - r)'M (x - r), without c.
        for t in range(frames):
            for j in range(n):
                i = t * n + j
                moved = 0.0
                for s in range(frames):
                    for k in range(n):
                        moved += extra_matrix[i, s * n + k] * (x[s, k] - extra_reference[s * n + k])
                cost += (x[t, j] - extra_reference[i]) * (moved - 2.0 * extra_slope[i])
                if derivatives:
                    g[i] += extra_slope[i] - moved
                    for k in range(i + 1):
                        h[i, k] += extra_matrix[i, k]
    return cost


@_jit
def descend(x, past, start, max_step, arm, goal, costs, bounds, iterations, damping, gain):
    """Improve the plan `x` (T, n) in place; it must keep the bounds, and every accepted one does.

    Args:
        x: Where to begin.
        past: The last three commands (3, n), oldest first; the last is what the first step starts from.
        start: That one.
        max_step: Bound on the steps (n,).
        arm: Chain, spheres, pairs of spheres and units of the joints.
        goal: Rotations (T, 3, 3), positions (T, 3) and the task, as `search.kernel_task` makes it.
        costs: Weights, posture (n,), prior (T, n) and its weight (T,), collision zone, and a quadratic of the user's.
        bounds: Lower and upper limits and margins (n,).
        iterations: Most steps.
        damping: Levenberg-Marquardt damping as a multiple of the squared pose residual of the frame (Sugihara 2011).
        gain: Fraction of the cost that a step must gain for another one to follow.

    Returns:
        Cost, residuals (T, 6), steps taken.
    """
    frames, n = x.shape
    unit, weights, extra = arm[3], costs[0], costs[5]
    size = frames * n
    lower, upper, _ = bounds
    h, work = np.zeros((size, size)), np.zeros((size, size))
    g, d, flat = np.empty(size), np.empty(size), np.empty(size)
    low, high = np.empty(size), np.empty(size)
    residuals, tried_residuals = np.empty((frames, 6)), np.empty((frames, 6))
    rotations, positions = np.empty((n + 1, 3, 3)), np.empty((n + 1, 3))
    tried = np.empty((frames, n))
    # Blocks of n couple with the three before them at most; row i of a block reaches to that block's first column.
    coupled = 0 if frames == 1 else (3 if weights[JERK] > 0.0 else 2)
    band = size - 1 if len(extra[1]) else min(size - 1, coupled * n + n - 1)
    cost = evaluate(x, past, arm, goal, costs, bounds, True, (h, g, rotations, positions, residuals))
    taken = 0
    fresh = True
    # Where the pose is met, a pull along a self-motion bends off it: the residual damps nothing there, this does.
    ridge = 0.0
    for _ in range(iterations):
        if not fresh:
            cost = evaluate(x, past, arm, goal, costs, bounds, True, (h, g, rotations, positions, residuals))
            fresh = True
        for t in range(frames):
            square = 0.0
            for k in range(6):
                square += residuals[t, k] * residuals[t, k]
            for j in range(n):
                i = t * n + j
                h[i, i] += damping * square + (ridge + 1e-9) * unit[j] * unit[j]
                flat[i] = x[t, j]
                if t == 0:
                    lo, hi = max(lower[j], start[j] - max_step[j]), min(upper[j], start[j] + max_step[j])
                    low[i], high[i] = min(lo, start[j] + max_step[j]), max(hi, start[j] - max_step[j])
                else:
                    low[i], high[i] = min(lower[j], x[t, j]), max(upper[j], x[t, j])
        if not bounded_newton(h, g, flat, low, high, band, d, work, n + 1 if frames == 1 else 3):
            break
        for t in range(frames):
            for j in range(n):
                tried[t, j] = x[t, j] + d[t * n + j]
        keep_bounds(tried, start, lower, upper, max_step)
        after = evaluate(
            tried, past, arm, goal, costs, bounds, False, (h, g, rotations, positions, tried_residuals)
        )
        if after < cost:
            done = cost - after < gain * cost
            x[:, :] = tried
            residuals[:, :] = tried_residuals
            cost = after
            taken += 1
            damping = max(damping / 4.0, 1e-6)
            ridge /= 4.0
            fresh = False
            if done:
                break
        else:
            damping *= 10.0
            ridge = max(
                4.0 * ridge, weights[VELOCITY] + weights[ACCELERATION] + weights[JERK] + weights[POSTURE]
            )
            if damping > 1e6:
                break
            fresh = False
    return cost, residuals, taken


@_jit
def one_after_the_other(
    x, kept, past, max_step, arm, goal, costs, exact_costs, bounds, iterations, damping, gain
):
    """Fill the frames of `x` (T, n) from `kept` on, each by both passes from the one before it.

    Args:
        x: Frames; those before `kept` stand.
        kept: Number of frames that stand.
        past, max_step, arm, goal, bounds, iterations, damping, gain: As for `descend`.
        costs: Of the first pass; its prior (T, n) and the prior's weight (T,) are for each frame.
        exact_costs: Of the second pass; its prior is the first one's answer, its prior's weight has one number.
    """
    frames, n = x.shape
    rotations, positions, task = goal
    weights, posture, prior, prior_weight, zone, extra = costs
    exact, _, _, pull, _, _ = exact_costs
    history, row = np.empty((3, n)), np.empty((1, n))
    for t in range(kept, frames):
        for k in range(3):
            earlier = t - 3 + k
            history[k] = x[earlier] if earlier >= 0 else past[earlier + 3]
        trusted = prior_weight[t] > 0.0
        row[0] = prior[t] if trusted else history[2]
        here = (rotations[t : t + 1], positions[t : t + 1], task)
        first = (weights, posture, prior[t : t + 1], prior_weight[t : t + 1], zone, extra)
        descend(row, history, history[2], max_step, arm, here, first, bounds, iterations, damping, gain)
        second = (exact, posture, row.copy(), pull, zone, extra)
        descend(row, history, history[2], max_step, arm, here, second, bounds, iterations, damping, gain)
        x[t] = row[0]
