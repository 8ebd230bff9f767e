"""`mimicik bench-speed`: how fast engines and the whole adapter answer, all in one run."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lerobot_mimicik.cli.eval import PolicySource
from lerobot_mimicik.cli.options import parse, say_loading, words

if TYPE_CHECKING:
    from lerobot_mimicik.evaluation.speed import Ask
    from lerobot_mimicik.kinematics.arms import ArmDescription
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy
    from lerobot_mimicik.solvers.base import IKSolver
    from robot_adapters.adapter import MimicIKAdapter

HELP = "Measure how fast engines and the whole adapter answer single queries, all in one run."

_FRAMES = 400  # of the motion, 20 s
_AHEAD = 8
_SWING = 0.25  # rad that every joint moves to either side
_BATCH = 4096  # queries that are answered at once
Array = NDArray[np.float64]


@dataclass
class BenchSpeedConfig:
    """Times from joints and target pose to command, along one smooth motion. Prints a table in Markdown.

    Example: `mimicik bench-speed --sizes=small,paper --queries=2000`
    """

    policy: PolicySource = field(default_factory=PolicySource)
    # Without a checkpoint: MimicIK networks of these recipes, untrained, which cost the same.
    sizes: str = "small,paper"
    # A shipped arm, or the path of a URDF; a checkpoint knows its own.
    arm: str = "airbot_play"
    # Engines to compare; eager is always among them.
    engines: str = "eager,traced,onnx"
    # How many queries of each row are timed.
    queries: int = 1000
    # Threads of torch; ONNX Runtime and the guided solver use one.
    threads: int = 1
    # Seconds in which batches of 4,096 queries are answered; 0: none are.
    batch_seconds: float = 2.0


def main(argv: Sequence[str]) -> int:
    """Parse the command line, measure and print."""
    config = parse(BenchSpeedConfig, argv, "mimicik bench-speed")
    say_loading()
    import torch

    from lerobot_mimicik.evaluation.speed import measure, table

    if config.threads < 1 or config.queries < 1:
        raise ValueError("--threads and --queries: expected at least 1")
    torch.set_num_threads(config.threads)
    policies = _policies(config)
    description = next(iter(policies.values())).config.arm_description()
    q, targets = motion(description)
    asked: dict[str, Ask] = {}
    missing: list[str] = []
    for name, policy in policies.items():
        for engine in dict.fromkeys(["eager", *words(config.engines)]):
            _add_engine(asked, missing, name, policy, engine, q, targets)
    for name, adapter in _adapters(config, description, policies, missing):
        asked[name] = _adapter_row(adapter, q, targets, 0)
        asked[f"{name}, {_AHEAD} ahead"] = _adapter_row(adapter, q, targets, _AHEAD)
    rows, machine = measure(asked, _FRAMES, config.queries)
    print(
        f"{_processor()}, {os.cpu_count()} processors; torch {torch.__version__} on {config.threads} threads{_onnx()}"
    )
    print(f"Networks in float32, guided solver in float64; {config.queries} queries of each row, in turns.\n")
    for name in policies:
        print(table([row for row in rows if row.name.startswith(f"{name}, ")], f"{name}, eager") + "\n")
    print(table([row for row in rows if row.name.startswith("adapter")]) + "\n")
    for name, policy in policies.items():
        if config.batch_seconds > 0:
            rate = _batches(policy, q, targets, config.batch_seconds)
            print(f"{name}: {rate:,.0f} solves a second in batches of {_BATCH:,} on {config.threads} threads")
    print(f"Memory taken while measuring: {machine.grown_mb:.1f} MB.")
    for each in [*missing, machine.busy]:
        if each:
            print(each)
    return 0


def motion(description: ArmDescription) -> tuple[Array, Array]:
    """Joints (T, dof) that swing smoothly about the arm's home, and the tool's poses (T, 7) one frame later."""
    from lerobot_mimicik.kinematics.plausibility import joint_limits
    from lerobot_mimicik.kinematics.point_chain import point_chain

    lower, upper = (np.clip(bound, -np.pi, np.pi) for bound in joint_limits(description))
    home = np.array(description.home) if description.home else (lower + upper) / 2
    phase = 2 * np.pi * (np.arange(_FRAMES + 1)[:, None] * np.arange(1, len(home) + 1) / _FRAMES)
    q = np.clip(home + _SWING * np.sin(phase), lower, upper)
    chain = point_chain(description)
    return q[:-1], np.array([chain.pose(each) for each in q[1:]])


def _policies(config: BenchSpeedConfig) -> dict[str, LearnedIKPolicy]:
    if config.policy.path:
        from lerobot_mimicik.checkpoints import kind_of, load_policy

        policy = load_policy(config.policy.path, "cpu").eval()
        return {kind_of(policy.config): policy}
    import json

    from lerobot_mimicik.configuration_mimicik import MimicIKConfig
    from lerobot_mimicik.evaluation.training_process import find_recipe
    from lerobot_mimicik.kinematics.arms import describe_arm
    from lerobot_mimicik.modeling_mimicik import MimicIKPolicy

    arm, found = describe_arm(config.arm), {}
    for size in words(config.sizes):
        options: dict[str, Any] = json.loads(find_recipe(f"{size}.json").read_text())["policy"]
        options = {key: value for key, value in options.items() if key != "type"}
        own = {"urdf": arm.urdf, "base_link": arm.base_link, "tip_link": arm.tip_link, "device": "cpu"}
        found[size] = MimicIKPolicy(MimicIKConfig(**options | own, joint_names=list(arm.joint_names))).eval()
    if not found:
        raise ValueError("--sizes names no recipe, and there is no --policy.path")
    return found


def _add_engine(
    asked: dict[str, Ask],
    missing: list[str],
    name: str,
    policy: LearnedIKPolicy,
    engine: str,
    q: Array,
    targets: Array,
) -> None:
    from lerobot_mimicik.inference.engine import EngineUnavailable
    from lerobot_mimicik.solvers.mimicik import MimicIKSolver

    solver = MimicIKSolver(policy.arm, policy, engine=engine)
    try:
        solver.solve(q[0], targets[0])
    except EngineUnavailable as error:
        missing.append(f"{name}, {engine}: {error}.")
        return
    asked[f"{name}, {engine}"] = _solver_row(solver, q, targets)


def _solver_row(solver: IKSolver, q: Array, targets: Array) -> Ask:
    solver.reset(q[0])
    return lambda t: solver.solve(q[t], targets[t])


def _adapters(
    config: BenchSpeedConfig,
    description: ArmDescription,
    policies: dict[str, LearnedIKPolicy],
    missing: list[str],
) -> list[tuple[str, MimicIKAdapter]]:
    from lerobot_mimicik.foresight.weights import shipped
    from lerobot_mimicik.kinematics.arms import describe_arm
    from lerobot_mimicik.kinematics.plausibility import why_not_same_arm
    from lerobot_mimicik.solvers.mimicik import MimicIKSolver
    from robot_adapters.adapter import AdapterSettings, MimicIKAdapter

    found = [("adapter: guided", MimicIKAdapter.for_arm(description))]
    weights = next(
        (each for each in shipped() if why_not_same_arm(describe_arm(each), description) is None), None
    )
    if weights is None:
        missing.append("adapter: guided with foresight: the package has no weights for this arm.")
    else:
        found.append(("adapter: guided with foresight", MimicIKAdapter.for_arm(description, weights)))
    for name, policy in policies.items():
        adapter = MimicIKAdapter(MimicIKSolver(policy.arm, policy), description, AdapterSettings())
        adapter.warm_up()
        assert isinstance(adapter.solver, MimicIKSolver)
        found.append((f"adapter: guided with {name} ({adapter.solver.engine})", adapter))
    return found


def _adapter_row(adapter: MimicIKAdapter, q: Array, targets: Array, ahead: int) -> Ask:
    def ask(t: int) -> object:
        if t == 0:
            adapter.reset()
        return adapter.solve(q[t], targets[t], targets[t + 1 : t + 1 + ahead] if ahead else None)

    return ask


def _batches(policy: LearnedIKPolicy, q: Array, targets: Array, seconds: float) -> float:
    """Queries a second, many at once."""
    import time

    from lerobot_mimicik.solvers.mimicik import MimicIKSolver

    solver = MimicIKSolver(policy.arm, policy)
    many = np.arange(_BATCH) % _FRAMES
    solver.reset(q[many])
    solver.solve(q[many], targets[many])
    begin, rounds = time.perf_counter(), 0
    while time.perf_counter() - begin < seconds:
        solver.solve(q[many], targets[many])
        rounds += 1
    return rounds * _BATCH / (time.perf_counter() - begin)


def _processor() -> str:
    try:
        with open("/proc/cpuinfo") as file:
            return next(line.partition(":")[2].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _onnx() -> str:
    try:
        import onnxruntime
    except ModuleNotFoundError:
        return ""
    return f", ONNX Runtime {onnxruntime.__version__} on 1"
