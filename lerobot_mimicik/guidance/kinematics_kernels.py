"""Compiled kinematics of one configuration: frames, Jacobians, pose errors and gaps between spheres.

Everything is numba in nopython mode, compiled once per machine and then read from numba's cache.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

_jit = njit(cache=True, error_model="numpy")


@_jit
def walk(q, step_rotations, step_positions, columns, prismatic, rotations, positions):
    """Frames of all bodies: fills `rotations` (n + 1, 3, 3) and `positions` (n + 1, 3); body 0 is the base."""
    n = len(columns)
    for a in range(3):
        positions[0, a] = 0.0
        for b in range(3):
            rotations[0, a, b] = 1.0 if a == b else 0.0
    for i in range(n):
        r, p = rotations[i], positions[i]
        s, o = step_rotations[i], step_positions[i]
        t, d = rotations[i + 1], positions[i + 1]
        for a in range(3):
            for b in range(3):
                t[a, b] = r[a, 0] * s[0, b] + r[a, 1] * s[1, b] + r[a, 2] * s[2, b]
            d[a] = p[a] + r[a, 0] * o[0] + r[a, 1] * o[1] + r[a, 2] * o[2]
        value = q[columns[i]]
        if prismatic[i]:
            for a in range(3):
                d[a] += t[a, 2] * value
        else:
            sine, cosine = math.sin(value), math.cos(value)
            for a in range(3):
                x, y = t[a, 0], t[a, 1]
                t[a, 0] = x * cosine + y * sine
                t[a, 1] = y * cosine - x * sine


@_jit
def tool_pose(rotations, positions, tool_rotation, tool_position, rotation, position):
    """Fill the tool's `rotation` (3, 3) and `position` (3,) from the frames of the bodies."""
    r, p = rotations[-1], positions[-1]
    for a in range(3):
        for b in range(3):
            rotation[a, b] = (
                r[a, 0] * tool_rotation[0, b] + r[a, 1] * tool_rotation[1, b] + r[a, 2] * tool_rotation[2, b]
            )
        position[a] = (
            p[a] + r[a, 0] * tool_position[0] + r[a, 1] * tool_position[1] + r[a, 2] * tool_position[2]
        )


@_jit
def point_jacobian(rotations, positions, columns, prismatic, body, point, jacobian):
    """Fill the linear Jacobian (3, n) of a `point` (3,) of the base frame that the body numbered `body` carries."""
    jacobian[:, :] = 0.0
    for i in range(body):
        j = columns[i]
        x, y, z = rotations[i + 1, 0, 2], rotations[i + 1, 1, 2], rotations[i + 1, 2, 2]
        if prismatic[i]:
            jacobian[0, j], jacobian[1, j], jacobian[2, j] = x, y, z
            continue
        ax = point[0] - positions[i + 1, 0]
        ay = point[1] - positions[i + 1, 1]
        az = point[2] - positions[i + 1, 2]
        jacobian[0, j] = y * az - z * ay
        jacobian[1, j] = z * ax - x * az
        jacobian[2, j] = x * ay - y * ax


@_jit
def pose_difference(rotation, position, target_rotation, target_position, error):
    """Fill `error` (6,): position difference [m] and rotation vector of R_target R^T [rad], base frame."""
    for a in range(3):
        error[a] = target_position[a] - position[a]
    e = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            e[a, b] = (
                target_rotation[a, 0] * rotation[b, 0]
                + target_rotation[a, 1] * rotation[b, 1]
                + target_rotation[a, 2] * rotation[b, 2]
            )
    x, y, z = e[2, 1] - e[1, 2], e[0, 2] - e[2, 0], e[1, 0] - e[0, 1]
    sine = 0.5 * math.sqrt(x * x + y * y + z * z)
    cosine = 0.5 * (e[0, 0] + e[1, 1] + e[2, 2] - 1.0)
    angle = math.atan2(sine, cosine)
    if sine > 1e-7:
        scale = 0.5 * angle / sine
        error[3], error[4], error[5] = scale * x, scale * y, scale * z
    elif cosine > 0.0:
        error[3], error[4], error[5] = 0.5 * x, 0.5 * y, 0.5 * z
    else:
        # Half a turn: the axis is the column of R + I that is longest.
        best, length = 0, -1.0
        for b in range(3):
            size = e[b, b] + 1.0
            if size > length:
                best, length = b, size
        norm = 0.0
        for a in range(3):
            error[3 + a] = e[a, best] + (1.0 if a == best else 0.0)
            norm += error[3 + a] * error[3 + a]
        norm = math.sqrt(norm)
        for a in range(3):
            error[3 + a] *= angle / norm


@_jit
def nearest_turn(rotation, target_rotation, axis, goal):
    """Fill `goal` (3, 3): the target's rotation, turned about its own `axis` (3,) to be nearest to R; zeros turn nothing.

    The turn by phi that makes trace(R^T R_target Rot(axis, phi)) largest.
    """
    x, y, z = axis
    for a in range(3):
        for b in range(3):
            goal[a, b] = target_rotation[a, b]
    if x == 0.0 and y == 0.0 and z == 0.0:
        return
    m = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            m[a, b] = (
                rotation[0, a] * target_rotation[0, b]
                + rotation[1, a] * target_rotation[1, b]
                + rotation[2, a] * target_rotation[2, b]
            )
    along = 0.0
    for a in range(3):
        for b in range(3):
            along += axis[a] * m[a, b] * axis[b]
    cosine = m[0, 0] + m[1, 1] + m[2, 2] - along
    sine = x * (m[1, 2] - m[2, 1]) + y * (m[2, 0] - m[0, 2]) + z * (m[0, 1] - m[1, 0])
    size = math.sqrt(sine * sine + cosine * cosine)
    if size < 1e-9:
        return
    sine, cosine = sine / size, cosine / size
    turn = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            turn[a, b] = (1.0 - cosine) * axis[a] * axis[b] + (cosine if a == b else 0.0)
    turn[0, 1] -= sine * z
    turn[0, 2] += sine * y
    turn[1, 0] += sine * z
    turn[1, 2] -= sine * x
    turn[2, 0] -= sine * y
    turn[2, 1] += sine * x
    for a in range(3):
        for b in range(3):
            goal[a, b] = (
                target_rotation[a, 0] * turn[0, b]
                + target_rotation[a, 1] * turn[1, b]
                + target_rotation[a, 2] * turn[2, b]
            )


@_jit
def weigh(error, target_rotation, weight, tolerance, tool_axes, residual, row_scale):
    """Dead zone and weight per axis: fills `residual` (6,) and `row_scale` (6,), the factor of its Jacobian's row.

    Where `tool_axes`, the axes are those of the target's frame, otherwise the base's.
    """
    for block in range(2):
        for a in range(3):
            value = 0.0
            if tool_axes:
                for b in range(3):
                    value += target_rotation[b, a] * error[3 * block + b]
            else:
                value = error[3 * block + a]
            k = 3 * block + a
            bound = tolerance[k]
            if value > bound:
                residual[k] = weight[k] * (value - bound)
                row_scale[k] = weight[k]
            elif value < -bound:
                residual[k] = weight[k] * (value + bound)
                row_scale[k] = weight[k]
            else:
                residual[k] = 0.0
                row_scale[k] = 0.0


@_jit
def rotation_of(quaternion, rotation):
    """Fill `rotation` (3, 3) of a unit quaternion x y z w."""
    x, y, z, w = quaternion
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - z * w),
        2 * (x * z + y * w),
    )
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = (
        2 * (x * y + z * w),
        1 - 2 * (x * x + z * z),
        2 * (y * z - x * w),
    )
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = (
        2 * (x * z - y * w),
        2 * (y * z + x * w),
        1 - 2 * (x * x + y * y),
    )


@_jit
def split_poses(poses):
    """Rotations (T, 3, 3) and positions (T, 3) of poses (T, 7) with unit quaternions."""
    frames = len(poses)
    rotations, positions = np.empty((frames, 3, 3)), np.empty((frames, 3))
    for t in range(frames):
        positions[t] = poses[t, :3]
        rotation_of(poses[t, 3:], rotations[t])
    return rotations, positions


@_jit
def pose_and_jacobian(q, chain):
    """Tool rotation (3, 3), position (3,) and geometric Jacobian (6, n), linear rows first, in the base frame."""
    step_rotations, step_positions, columns, prismatic, tool_rotation, tool_position = chain
    n = len(columns)
    rotations, positions = np.empty((n + 1, 3, 3)), np.empty((n + 1, 3))
    walk(q, step_rotations, step_positions, columns, prismatic, rotations, positions)
    rotation, position, jacobian = np.empty((3, 3)), np.empty(3), np.empty((6, n))
    tool_pose(rotations, positions, tool_rotation, tool_position, rotation, position)
    point_jacobian(rotations, positions, columns, prismatic, n, position, jacobian[:3])
    for i in range(n):
        for a in range(3):
            jacobian[3 + a, columns[i]] = 0.0 if prismatic[i] else rotations[i + 1, a, 2]
    return rotation, position, jacobian


@_jit
def steps_towards(q, targets, chain, lever, damping):
    """Damped least squares steps (T, n) from joints (n,) towards poses (T, 7), and the pose errors (T, 6).

    Rotations count `lever` metres a radian, and `damping` [m] is the square root of what is added to J J^T.
    """
    rotation, position, jacobian = pose_and_jacobian(q, chain)
    jacobian[3:] *= lever
    errors, there = np.empty((len(targets), 6)), np.empty((3, 3))
    for t in range(len(targets)):
        rotation_of(targets[t, 3:], there)
        pose_difference(rotation, position, there, targets[t, :3], errors[t])
    errors[:, 3:] *= lever
    square = jacobian @ jacobian.T
    for a in range(6):
        square[a, a] += damping**2
    return np.linalg.solve(square, errors.T).T @ jacobian, errors


@_jit
def judge(q, target, chain, weight, tolerance, tool_axes, axis):
    """What a configuration leaves of a target (7,).

    Returns:
        Error (6,) beyond the tolerances, 0 on free axes [m, rad]; position error [m]; rotation error [rad].
    """
    step_rotations, step_positions, columns, prismatic, tool_rotation, tool_position = chain
    n = len(columns)
    rotations, positions = np.empty((n + 1, 3, 3)), np.empty((n + 1, 3))
    walk(q, step_rotations, step_positions, columns, prismatic, rotations, positions)
    rotation, position, goal = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    tool_pose(rotations, positions, tool_rotation, tool_position, rotation, position)
    rotation_of(target[3:], goal)
    error, left, scale, counted = np.empty(6), np.empty(6), np.empty(6), np.empty(6)
    nearest = np.empty((3, 3))
    nearest_turn(rotation, goal, axis, nearest)
    pose_difference(rotation, position, nearest, target[:3], error)
    for k in range(6):
        counted[k] = 1.0 if weight[k] > 0.0 else 0.0
    weigh(error, goal, counted, tolerance, tool_axes, left, scale)
    pose_difference(rotation, position, goal, target[:3], error)
    distance = math.sqrt(error[0] ** 2 + error[1] ** 2 + error[2] ** 2)
    angle = math.sqrt(error[3] ** 2 + error[4] ** 2 + error[5] ** 2)
    return left, distance, angle


@_jit
def sphere_gap(q, chain, spheres, pairs):
    """Smallest gap between the pairs of spheres [m], infinite without pairs, and the number of that pair."""
    step_rotations, step_positions, columns, prismatic, _, _ = chain
    centres, radii, bodies = spheres
    n = len(columns)
    rotations, positions = np.empty((n + 1, 3, 3)), np.empty((n + 1, 3))
    walk(q, step_rotations, step_positions, columns, prismatic, rotations, positions)
    placed = np.empty((len(radii), 3))
    for s in range(len(radii)):
        r, p, c = rotations[bodies[s]], positions[bodies[s]], centres[s]
        for a in range(3):
            placed[s, a] = p[a] + r[a, 0] * c[0] + r[a, 1] * c[1] + r[a, 2] * c[2]
    smallest, which = np.inf, -1
    for k in range(len(pairs)):
        a, b = pairs[k, 0], pairs[k, 1]
        square = 0.0
        for i in range(3):
            square += (placed[a, i] - placed[b, i]) ** 2
        gap = math.sqrt(square) - radii[a] - radii[b]
        if gap < smallest:
            smallest, which = gap, k
    return smallest, which
