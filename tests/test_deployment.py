"""Deployment over the bus: along recorded and generated motion, in plant mode, and what the reports say."""

import json
import threading
from dataclasses import replace

import numpy as np
import pytest
from arm_process import arm_process
from pace import judged_by_the_pace

from lerobot_mimicik.cli.main import main
from lerobot_mimicik.evaluation.rollouts import RolloutOptions, known_modes, make_rollouts
from lerobot_mimicik.evaluation.trajectories import Trajectory
from lerobot_mimicik.foresight.weights import SHIPPED
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.chain import SerialArm
from lerobot_mimicik.solvers import make_solver
from robot_adapters.adapter import MimicIKAdapter
from robot_adapters.airbot.od_motor import OdMotor
from robot_adapters.arm import Arm, SimulatedArmCell
from robot_adapters.can.bus import BusError, open_bus
from robot_adapters.checks import CheckOutcome
from robot_adapters.deployment import approach, drive
from robot_adapters.doctor import Doctor, DoctorOptions
from robot_adapters.drivers import DRIVERS, arm_checks, simulated_cell
from robot_adapters.plant_mode import refuse_another_arm
from robot_adapters.simulation.cell import SimulatedCell
from robot_adapters.simulation.faults import Fault, FaultKind

ARM = describe_arm("airbot_play")
HOME = np.array(ARM.home)


@pytest.fixture(scope="module")
def circle() -> Trajectory:
    adapter = MimicIKAdapter(make_solver("hold", SerialArm(ARM)), ARM)
    phase = np.linspace(0, 2 * np.pi, 80)
    target = np.repeat(adapter.forward(HOME)[None], 80, axis=0)
    target[:, 1] += 0.04 * np.sin(phase)
    target[:, 2] += 0.04 * (1 - np.cos(phase))
    return Trajectory(0, np.repeat(HOME[None], 80, axis=0), target)


def test_plant_mode_refuses_another_arms_motion_that_has_as_many_joints():
    q, target = np.tile(HOME, (2, 1)), np.tile([0.3, 0, 0.3, 0, 0, 0, 1.0], (2, 1))
    refuse_another_arm(Trajectory(0, q, target, arm=ARM))
    refuse_another_arm(Trajectory(0, q, target, arm=replace(ARM, tool_offset=(0, 0, 0.1, 0.3, 0, 0))))
    piper, hold = describe_arm("piper"), make_solver("hold", SerialArm(ARM))
    assert piper.joint_names == ARM.joint_names
    with pytest.raises(ValueError, match=r"trajectory 3.*move the tool elsewhere"):
        make_rollouts("plant", hold, [Trajectory(3, q, target, arm=piper)])
    renamed = replace(ARM, joint_names=ARM.joint_names[::-1], home=())
    with pytest.raises(ValueError, match="expected joint1, joint2"):
        make_rollouts("plant", hold, [Trajectory(0, q, target, arm=renamed)])
    with pytest.raises(ValueError, match="with 5 joints: expected 6"):
        make_rollouts("plant", hold, [Trajectory(0, q[:, :5], target)])


def test_plant_mode_is_found_and_drives_the_simulated_arm(circle):
    assert "plant" in known_modes()
    (rollout,) = make_rollouts("plant", make_solver("mink", SerialArm(ARM)), [circle], RolloutOptions(seed=1))
    assert rollout.asked == 80
    arm = MimicIKAdapter(make_solver("hold", SerialArm(ARM)), ARM)
    errors = [
        np.linalg.norm(arm.forward(q)[:3] - t[:3]) for q, t in zip(rollout.q_cmd, circle.target, strict=True)
    ]
    assert np.mean(errors) < 0.002
    assert np.abs(rollout.q_cmd - rollout.q_curr).max() <= 0.1 + 1e-9


def test_a_bounded_step_follows_a_lagging_arm_only_from_the_command_in_force(circle):
    faster = Trajectory(circle.index, circle.q[::3], circle.target[::3])
    errors = {}
    for mode in ("plant", "plant_commanded"):
        solver = make_solver("mink", SerialArm(ARM), max_step=0.05)
        (rollout,) = make_rollouts(mode, solver, [faster], RolloutOptions(seed=1))
        arm = MimicIKAdapter(make_solver("hold", SerialArm(ARM)), ARM)
        errors[mode] = max(
            np.linalg.norm(arm.forward(q)[:3] - t[:3])
            for q, t in zip(rollout.q_cmd, faster.target, strict=True)
        )
    assert errors["plant_commanded"] < 0.005 < 0.02 < errors["plant"]


def test_the_same_seed_gives_the_same_drive(circle):
    runs = [
        make_rollouts("plant", make_solver("mink", SerialArm(ARM)), [circle], RolloutOptions(seed=5))[0].q_cmd
        for _ in range(2)
    ]
    np.testing.assert_array_equal(*runs)


def test_adapter_over_the_bus_tracks_without_a_limit_touched(circle):
    adapter = MimicIKAdapter(make_solver("mink", SerialArm(ARM)), ARM)
    with SimulatedCell(q=HOME + 0.2, listen=True) as cell:
        cell.arm.connect()
        approach(cell.arm, cell.clock, HOME, 0.05)
        log = drive(
            cell.arm,
            cell.clock,
            lambda q, t, _: adapter.solve(q, t).q,
            circle.target,
            20.0,
            cell.clock.monotonic,
        )
        assert log.asked == 80
        assert set(log.statuses) == {"accepted"}
        tool = np.array([adapter.forward(q)[:3] for q in log.measured])
        assert np.linalg.norm(tool - circle.target[:, :3], axis=1).mean() < 0.02  # the arm's lag
        assert cell.simulation.warnings == 0
        cell.listener.poll()
        assert cell.listener.violations == []


def test_a_drive_ends_where_the_arm_stops(circle):
    adapter = MimicIKAdapter(make_solver("mink", SerialArm(ARM)), ARM)
    with SimulatedCell(
        q=HOME, faults=[Fault(FaultKind.MOTOR_ERROR, motor_id=5, start=2.0, magnitude=12)]
    ) as cell:
        cell.arm.connect()
        log = drive(
            cell.arm,
            cell.clock,
            lambda q, t, _: adapter.solve(q, t).q,
            circle.target,
            20.0,
            cell.clock.monotonic,
        )
    assert log.asked < 80
    assert "MotorFault" in log.stopped


def test_a_drive_ends_at_a_command_that_is_not_finite(circle):
    with SimulatedCell(q=HOME) as cell:
        cell.arm.connect()
        log = drive(
            cell.arm, cell.clock, lambda *_: np.full(6, np.nan), circle.target, 20.0, cell.clock.monotonic
        )
    assert log.asked == 1
    assert log.statuses == {"refused": 1}


@pytest.mark.parametrize("real_time", [False, True])
def test_deploy_command(mimicik_run, tmp_path, real_time):
    if real_time:
        with judged_by_the_pace():
            check_deploy_command(mimicik_run, tmp_path, "--real_time=true", "--reference=measured")
    else:
        check_deploy_command(mimicik_run, tmp_path, "--real_time=false")


def check_deploy_command(mimicik_run, tmp_path, *options: str) -> None:
    out = tmp_path / "report"
    assert (
        main(
            [
                "deploy",
                f"--policy.path={mimicik_run}",
                f"--dataset.root={mimicik_run.parent / 'data' / 'ood'}",
                "--dataset.episodes=0",
                "--dataset.seconds=5",
                f"--display_file={tmp_path / 'deployment.rrd'}",
                f"--output={out}",
                *options,
            ]
        )
        == 0
    )
    (row,) = json.loads((out / "report.json").read_text())["rows"]
    assert (row["mode"], row["solver"], row["frames"]) == ("plant", "mimicik_guided", 100)
    assert row["estop"] == 0
    summary = json.loads((out / "deployment.json").read_text())
    assert summary["frames"] == 100
    assert summary["work_ms"]["p99"] >= summary["solve_ms"]["median"] > 0
    assert summary["stolen_percent"] is None or 0 <= summary["stolen_percent"] <= 100
    assert summary["protections"][0]["frames_above_0.1_rad"] == 0
    assert not summary["protections"][0]["emergency_stop"]
    assert sum(summary["ik"]["statuses"].values()) == 100
    assert (tmp_path / "deployment.rrd").stat().st_size > 10_000


def stands_still(witness) -> bool | None:
    """Whether the next command of the joints 1 to 3 repeats the positions before; None where none comes."""
    positions = []
    while len(positions) < 6:
        frame = witness.recv(0.5)
        if frame is None:
            return None
        if frame.arbitration_id in (1, 2, 3) and (command := OdMotor(frame.arbitration_id).decode_mit(frame)):
            positions.append((frame.arbitration_id, command.position))
    return set(positions[:3]) == set(positions[3:])


def test_a_deployment_that_the_arm_ends_is_reported_as_far_as_it_went(mimicik_run, tmp_path, capsys):
    pytest.importorskip("msgpack")
    channel = "239.74.163.78"
    try:
        witness = open_bus("udp_multicast", channel)
    except BusError as error:
        pytest.skip(f"no multicast here: {error}")
    data = mimicik_run.parent / "data" / "ood"
    options = [f"--policy.path={mimicik_run}", f"--dataset.root={data}", f"--output={tmp_path}"]
    with witness, arm_process("udp_multicast", channel) as arm:

        def cut_the_power():
            """After the way to the start, 15 frames of rest there, and a part of the trajectory."""
            for still, count in ((False, 20), (True, 80), (False, 250)):
                seen = 0
                while seen < count and not over.is_set():
                    now = stands_still(witness)
                    seen = seen + 1 if now is still else 0 if still else seen
            arm.kill()

        over = threading.Event()
        power = threading.Thread(target=cut_the_power)
        power.start()
        try:
            with judged_by_the_pace():
                assert main(["deploy", *options, "--interface=udp_multicast", f"--channel={channel}"]) == 1
                assert "The arm stopped" in capsys.readouterr().err
        finally:
            over.set()
            power.join()
    (row,) = json.loads((tmp_path / "report.json").read_text())["rows"]
    summary = json.loads((tmp_path / "deployment.json").read_text())
    assert 0 < summary["frames"] < row["frames"] == 400
    assert row["episodes"] == 1
    assert "FeedbackTimeout" in summary["stopped"]


# --- The doctor ---


def outcomes(**options) -> dict[str, CheckOutcome]:
    return {finding.check: finding.outcome for finding in Doctor(DoctorOptions(**options)).run()}


def test_doctor_finds_a_simulated_arm_and_its_checkpoint_well(mimicik_run):
    adapter = MimicIKAdapter(make_solver("hold", SerialArm(ARM)), ARM)
    found = outcomes(
        interface="virtual", policy_path=str(mimicik_run), reported_pose=adapter.forward(HOME).tolist()
    )
    assert set(found.values()) == {CheckOutcome.OK}
    assert {"plugin", "bus", "boards", "motors", "ranges", "checkpoint against robot"} <= set(found)
    assert "FK against the reported pose" in found


def test_doctor_names_failures_with_remedies_and_skips_what_rests_on_them(tmp_path):
    findings = Doctor(
        DoctorOptions(interface="slcan", channel="/dev/does-not-exist", policy_path=str(tmp_path))
    ).run()
    found = {finding.check: finding for finding in findings}
    for name in ("checkpoint", "bus"):
        assert found[name].outcome is CheckOutcome.FAILED
        assert found[name].remedy
    for name in ("checkpoint against robot", "boards", "motors", "joint limits"):
        assert found[name].outcome is CheckOutcome.SKIPPED


def test_doctor_sees_a_pose_that_does_not_fit(mimicik_run):
    found = outcomes(interface="virtual", reported_pose=[0.5, 0.0, 0.35, 0.0, 0.0, 0.0, 1.0])
    assert found["FK against the reported pose"] is CheckOutcome.FAILED
    assert found["joint limits"] is CheckOutcome.OK


# --- Drivers ---


@pytest.mark.parametrize("name", DRIVERS)
def test_every_driver_has_what_an_arm_needs(name):
    with simulated_cell(name) as cell:
        cell.arm.connect()
        assert cell.arm.is_connected
        assert cell.protections()["emergency_stop"] is False
        named = {each for protocol in (Arm, SimulatedArmCell) for each in protocol.__protocol_attrs__}
        missing = [each for each in named if not (hasattr(cell.arm, each) or hasattr(cell, each))]
        assert not missing
        checks = arm_checks(name, "virtual", cell.channel, cell.clock)
        assert "motors" in [check.name for check in checks.checks()]
        checks.close()


def test_deploy_drives_no_arm_with_another_arms_checkpoint(tmp_path, capsys):
    options = [f"--policy.path={SHIPPED / 'piper'}", "--interface=virtual", f"--output={tmp_path / 'out'}"]
    assert main(["deploy", *options]) == 1
    assert "checkpoint of another arm" in capsys.readouterr().err


def test_an_arm_that_nobody_drives_is_refused_by_name():
    with pytest.raises(ValueError, match="known are airbot_play"):
        simulated_cell("airbot_ply")
