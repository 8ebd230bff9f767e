"""`mimicik deploy`: the paper's deployment, an arm driven along targets at 20 Hz, with or without a checkpoint."""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_mimicik import outputs
from lerobot_mimicik.cli.options import parse, say_loading

if TYPE_CHECKING:
    from lerobot_mimicik.evaluation.evaluate import StudiedSet
    from robot_adapters.adapter import MimicIKAdapter
    from robot_adapters.deployment import DeploymentLog

HELP = "Drive an arm, real or simulated, along end-effector targets at 20 Hz, with a checkpoint or without, and measure it."


@dataclass
class PolicyPath:
    """The MimicIK checkpoint."""

    # A checkpoint's folder, a training run's output folder, or a Hub repository. Empty: the guided solver alone.
    path: str = ""


@dataclass
class MotionSource:
    """The end-effector motion to follow."""

    # Folder of a LeRobot dataset with joints and target poses; empty: near-singular motion is generated.
    root: str = ""
    # Episodes to drive, as numbers and ranges such as 0-9,12; empty: all of them.
    episodes: str = ""
    # Seconds of each episode; 0: all.
    seconds: float = 0.0


@dataclass
class DeployConfig:
    """Options of `mimicik deploy`. Writes report.json and report.md, as `mimicik eval`, and deployment.json.

    Example: `mimicik deploy --interface=virtual --real_time=false --output=outputs/deploy`
    """

    policy: PolicyPath = field(default_factory=PolicyPath)
    dataset: MotionSource = field(default_factory=MotionSource)
    # Which arm is driven: airbot_play.
    arm: str = "airbot_play"
    # python-can's interface of the arm: socketcan, slcan, udp_multicast; virtual starts a simulated arm.
    interface: str = "virtual"
    # can0, /dev/ttyACM0, a multicast address; null: the interface's usual one.
    channel: str | None = None
    # interface=virtual: run in real time, or as fast as the computer can.
    real_time: bool = True
    # interface=virtual: what the simulated arm carries at its tool [kg] without the driver's knowledge.
    payload: float = 0.0
    # Joints that a step starts from: commanded (the command in force) or measured.
    reference: str = "commanded"
    # Frames after the present one that the solver is told of. 0: none, as where an operator or a policy gives one
    # target at a time; 7: as a policy that answers with chunks lets it know.
    look_ahead: int = 0
    # Where the network runs.
    device: str = "cpu"
    # Threads that torch uses.
    threads: int = 1
    # Show the deployment in rerun.
    display: bool = False
    # Write what rerun would show to this file (.rrd) instead of opening its viewer.
    display_file: str = ""
    # Where the report goes.
    output: str = "outputs/deploy"
    # For the simulated arm's noise and generated motion.
    seed: int = 0


def main(argv: Sequence[str]) -> int:
    """Run the command; status 1 where the arm stopped before the end."""
    config = parse(DeployConfig, argv, "mimicik deploy")
    with outputs.alone(config.output):
        summary, row = run(config)
    from lerobot_mimicik.evaluation.report import markdown_table

    print(markdown_table([row]))
    for key in (
        "control_period_ms",
        "work_ms",
        "work_p99_ms_by_trajectory",
        "solve_ms",
        "stolen_percent",
        "loop_250hz",
        "ik",
        "tool_error_mm",
        "commands",
        "events",
        "protections",
    ):
        print(f"{key}: {json.dumps(summary[key])}")
    print(f"Report: {config.output}/report.json, {config.output}/deployment.json")
    if summary["stopped"]:
        print(f"The arm stopped: {summary['stopped']}", file=sys.stderr)
        return 1
    return 0


def run(config: DeployConfig, progress: bool = True) -> tuple[dict[str, Any], dict[str, Any]]:
    """Deploy and write the reports; the content of deployment.json, and the report's row.

    Raises:
        ValueError: An option does not fit.
        FileExistsError: A report, or a recording for rerun, is there that this project did not write.
        FileNotFoundError: The checkpoint or the dataset does not exist.
        ConnectionError: The arm does not answer.
    """
    from lerobot_mimicik.checkpoints import check_device, find_checkpoint
    from lerobot_mimicik.inputs import check_dataset
    from robot_adapters.drivers import driver_of

    driver_of(config.arm)
    if config.look_ahead < 0:
        raise ValueError(f"--look_ahead={config.look_ahead}: expected a number of frames, 0 or more")
    if not 0.0 <= config.payload <= 10.0:
        raise ValueError(f"--payload={config.payload}: expected a mass in kg, 0 to 10")
    if config.payload and config.interface != "virtual":
        raise ValueError(
            "--payload is for the simulated arm (--interface=virtual); a real one knows what it carries"
        )
    if config.policy.path:
        find_checkpoint(config.policy.path)
        check_device(config.device)
    if config.dataset.root:
        check_dataset(config.dataset.root, "--dataset.root")
    if config.display_file:
        from robot_adapters.display import check_recording

        check_recording(config.display_file)
    if progress:
        say_loading()
    import torch

    from lerobot_mimicik.evaluation.evaluate import make_evaluation
    from lerobot_mimicik.evaluation.latency import Latency
    from lerobot_mimicik.evaluation.metrics import measure
    from lerobot_mimicik.evaluation.report import write_report
    from lerobot_mimicik.evaluation.rollouts import Rollout
    from lerobot_mimicik.kinematics.chain import SerialArm

    outputs.claim(config.output, "report")
    torch.set_num_threads(config.threads)
    adapter = _adapter(config)
    arm = SerialArm(adapter.description, dtype=torch.float64)
    recording = _motion(config, adapter, arm)
    before = _processor_time()
    logs, extra = _drive(config, adapter, recording, progress)
    used, stolen = _processor_time() - before
    extra["stolen_percent"] = round(100 * float(stolen / used), 1) if used else None
    recording = recording.first(len(logs))  # the arm may have stopped before the others
    rollouts = [
        Rollout(trajectory, log.before, log.commanded, log.asked)
        for trajectory, log in zip(recording.set.trajectories, logs, strict=True)
    ]
    traces = tuple(measure(arm, rollouts))
    solve = [ms for log in logs for ms in log.solve_ms]
    latency = Latency(_percentile(solve, 50), _percentile(solve, 99), len(solve))
    evaluation = make_evaluation(arm, extra["ik"]["solver"], "plant", recording, traces, latency)
    write_report(config.output, [evaluation.row], [recording], asdict(config))
    summary = _summary(logs) | extra | {"tool_error_mm": _tool_error(adapter, recording, logs)}
    (Path(config.output) / "deployment.json").write_text(json.dumps(summary, indent=2) + "\n")
    return summary, evaluation.row


def _adapter(config: DeployConfig) -> MimicIKAdapter:
    """With the checkpoint, or for the arm of the motion."""
    from lerobot_mimicik.kinematics.arms import arm_of_dataset, describe_arm
    from robot_adapters.adapter import MimicIKAdapter

    settings: dict[str, Any] = {"reference": config.reference, "horizon": config.look_ahead + 1}
    if config.policy.path:
        adapter = MimicIKAdapter.from_pretrained(config.policy.path, config.device, **settings)
        adapter.check_arm(describe_arm(config.arm), f"--policy.path={config.policy.path}")
        return adapter
    own = arm_of_dataset(config.dataset.root) if config.dataset.root else None
    return MimicIKAdapter.for_arm(own or describe_arm(config.arm), **settings)


def _solver_name(config: DeployConfig) -> str:
    """What tables of `eval` and `bench` call that which drives the arm."""
    if config.policy.path:
        return "mimicik_guided"
    return "guided_ahead" if config.look_ahead else "guided"


def _motion(config: DeployConfig, adapter: MimicIKAdapter, arm: Any) -> StudiedSet:
    """The motion to follow: recorded, or the generated near-singular set."""
    import tempfile

    from lerobot_mimicik.cli.options import numbers
    from lerobot_mimicik.evaluation.evaluate import study
    from lerobot_mimicik.evaluation.trajectories import Layout, load_trajectories
    from lerobot_mimicik.solvers.mimicik import MimicIKSolver
    from robot_adapters.plant_mode import refuse_another_arm

    layout = Layout()
    if isinstance(adapter.solver, MimicIKSolver) and config.dataset.root:
        layout = Layout.of_policy(adapter.solver.policy.config)
    with tempfile.TemporaryDirectory() as folder:
        root = Path(config.dataset.root or _generated(Path(folder), config))
        episodes = numbers(config.dataset.episodes, "--dataset.episodes") or None
        found = load_trajectories(root, arm, layout, episodes, root.name)
    for trajectory in found.trajectories:
        refuse_another_arm(trajectory, config.arm)
    if config.dataset.seconds:
        last = max(int(config.dataset.seconds * found.fps), 1)
        cut = tuple(t.first(last) for t in found.trajectories)
        found = replace(found, trajectories=cut)
    return study(arm, found)


def _generated(folder: Path, config: DeployConfig) -> Path:
    from lerobot_mimicik.data.teleoperation.synthetic import make_synthetic
    from lerobot_mimicik.kinematics.arms import describe_arm

    make_synthetic(folder, 1, describe_arm(config.arm), seed=config.seed, test_share=0.0, progress=False)
    return folder / "ood"


def _drive(
    config: DeployConfig, adapter: MimicIKAdapter, recording: StudiedSet, progress: bool
) -> tuple[list[DeploymentLog], dict[str, Any]]:
    """Drive every trajectory, and say what driver and simulated arm counted."""
    from lerobot_mimicik.evaluation.rollouts import frame_bar
    from robot_adapters.arm import SimulatedArmCell
    from robot_adapters.clock import RealClock, SimulatedClock
    from robot_adapters.deployment import Watcher, approach, drive
    from robot_adapters.display import RerunDisplay
    from robot_adapters.drivers import open_arm, simulated_cell

    fps = recording.set.fps
    watchers: list[Watcher] = []
    if config.display or config.display_file:
        watchers.append(RerunDisplay(adapter, fps, config.display_file or None).frame)
    statuses: Counter[str] = Counter()
    sources: Counter[str] = Counter()
    worst: dict[str, float] = {"position_error_mm": 0.0, "step_rad": 0.0}

    def control(q: Any, target: Any, upcoming: Any) -> Any:
        result = adapter.solve(q, target, upcoming[: config.look_ahead])
        statuses[result.status] += 1
        sources[result.source] += 1
        worst["position_error_mm"] = max(worst["position_error_mm"], result.position_error * 1e3)
        worst["step_rad"] = max(worst["step_rad"], result.step)
        return result.q

    logs: list[DeploymentLog] = []
    loops, protections = [], []
    with frame_bar(recording.set.frames, "deploying", progress) as bar:
        for number, trajectory in enumerate(recording.set.trajectories):
            cell: SimulatedArmCell | None = None
            if config.interface == "virtual":
                clock: Any = RealClock() if config.real_time else SimulatedClock()
                cell = simulated_cell(
                    config.arm,
                    clock,
                    q=trajectory.q[0],
                    payload=config.payload,
                    seed=config.seed + number,
                    handle_signals=config.real_time,
                )
                arm, clock = cell.arm, cell.clock
            else:
                clock = RealClock()
                arm = open_arm(config.arm, config.interface, config.channel, clock=clock)
            adapter.reset()
            try:
                arm.connect()
                try:
                    approach(arm, clock, trajectory.q[0], 1.0 / fps)
                except RuntimeError as error:
                    if not logs:
                        raise
                    logs[-1].stopped = str(error)
                    break
                log = drive(
                    arm,
                    clock,
                    _after_commands(control, adapter, arm),
                    trajectory.target,
                    fps,
                    time.perf_counter,
                    [*watchers, lambda *_: bar.update(1)],  # type: ignore[list-item]
                )
                loops.append(arm.statistics())
                if cell is not None:
                    protections.append(cell.protections())
            finally:
                arm.close()
                if cell is not None:
                    cell.close()
            logs.append(log)
            if log.stopped:
                break
    extra = {
        "ik": {
            "solver": _solver_name(config),
            "look_ahead": config.look_ahead,
            "statuses": dict(statuses),
            "sources": dict(sources),
            **{name: round(value, 4) for name, value in worst.items()},
        },
        "loop_250hz": [
            {
                "period_mean_ms": round(each.period_mean_ms, 3),
                "period_p99_ms": round(each.period_p99_ms, 3),
                "period_max_ms": round(each.period_max_ms, 3),
                "jitter_std_ms": round(each.jitter_std_ms, 3),
                "overruns": each.overruns,
                "ticks": each.ticks,
            }
            for each in loops
        ],
        "protections": protections,
    }
    return logs, extra


def _after_commands(control: Any, adapter: MimicIKAdapter, arm: Any) -> Any:
    """The controller, told before each frame what the driver made of the command before."""
    first = True

    def controller(q: Any, target: Any, upcoming: Any) -> Any:
        nonlocal first
        if not first:
            adapter.commanded(arm.target())
        first = False
        return control(q, target, upcoming)

    return controller


def _tool_error(
    adapter: MimicIKAdapter, recording: StudiedSet, logs: list[DeploymentLog]
) -> dict[str, float]:
    """Between where the tool was measured and the target of that frame: the arm's lag included."""
    import numpy as np

    errors = [
        float(np.linalg.norm(adapter.forward(q)[:3] - target[:3]) * 1e3)
        for trajectory, log in zip(recording.set.trajectories, logs, strict=True)
        for q, target in zip(log.measured[: log.asked], trajectory.target[: log.asked], strict=True)
    ]
    return {"median": _percentile(errors, 50), "p95": _percentile(errors, 95)}


def _processor_time() -> Any:
    """Total and stolen time of all processors so far; zeros where the system does not report them."""
    import numpy as np

    stat = Path("/proc/stat")
    if not stat.is_file():
        return np.zeros(2)
    # user nice system idle iowait irq softirq steal
    ticks = [int(word) for word in stat.read_text().splitlines()[0].split()[1:9]]
    return np.array([sum(ticks), ticks[7]])


def _summary(logs: list[DeploymentLog]) -> dict[str, Any]:
    periods = [ms for log in logs for ms in log.period_ms]
    work = [ms for log in logs for ms in log.work_ms]
    solve = [ms for log in logs for ms in log.solve_ms]
    return {
        "frames": sum(log.asked for log in logs),
        "work_p99_ms_by_trajectory": [_percentile(log.work_ms, 99) for log in logs],
        "control_period_ms": {"median": _percentile(periods, 50), "p99": _percentile(periods, 99)}
        | {"max": _percentile(periods, 100)},
        "work_ms": {"median": _percentile(work, 50), "p99": _percentile(work, 99)},
        "solve_ms": {"median": _percentile(solve, 50), "p99": _percentile(solve, 99)},
        "commands": dict(sum((log.statuses for log in logs), Counter())),
        "events": dict(sum((log.events for log in logs), Counter())),
        "stopped": next((log.stopped for log in logs if log.stopped), ""),
    }


def _percentile(values: list[float], share: float) -> float:
    import numpy as np

    return round(float(np.percentile(values, share)), 3) if values else 0.0
