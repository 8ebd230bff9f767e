"""Foresight: what it sees, how it learns, and the promise of how far it moves a target."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from lerobot_mimicik.batches.rollouts import Hand, drive, pieces
from lerobot_mimicik.cli import main as cli
from lerobot_mimicik.configuration_foresight import ForesightConfig
from lerobot_mimicik.data.stress.sets import make_stress
from lerobot_mimicik.foresight.features import PAST_STEPS, Features, legendre
from lerobot_mimicik.foresight.foresight import Foresight
from lerobot_mimicik.foresight.gauge import TremorGauge
from lerobot_mimicik.foresight.network import STEP_RAD
from lerobot_mimicik.foresight.weights import load_weights, pack, shipped
from lerobot_mimicik.guidance.guided import Guidance
from lerobot_mimicik.guidance.model import arm_model
from lerobot_mimicik.guidance.settings import GuidanceSettings
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.poses import pose_distance
from lerobot_mimicik.kinematics.tremor import displaced, tremor
from lerobot_mimicik.modeling_foresight import ForesightPolicy
from robot_adapters.adapter import MimicIKAdapter

ARM = describe_arm("airbot_play")
HOME = np.array(ARM.home)


def sweep(frames: int) -> np.ndarray:
    """Smooth joints (frames, 6) about home."""
    t = np.linspace(0.0, 4.0, frames)[:, None]
    return HOME + 0.2 * np.sin(t + np.arange(6))


def config(**changes) -> ForesightConfig:
    return ForesightConfig(urdf="airbot_play", device="cpu", hidden_dim=16, n_layers=2, **changes)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """A policy of random weights, and the folder it was saved to."""
    torch.manual_seed(0)
    policy = ForesightPolicy(config())
    policy.delta.fit(torch.full((6,), -STEP_RAD), torch.full((6,), STEP_RAD))  # as training does
    for parameter in policy.average.network.parameters():
        parameter.data.normal_(std=0.02)
    folder = tmp_path_factory.mktemp("foresight")
    policy.save_pretrained(folder)
    return policy, folder


def test_the_basis_is_orthonormal_and_smooth_motion_fills_its_low_orders():
    basis = legendre(14)
    assert np.allclose(basis @ basis.T, np.eye(14), atol=1e-9)
    assert np.abs(basis[4:] @ np.linspace(-1, 1, 14) ** 3).max() < 1e-9


def test_the_first_number_is_a_step_that_meets_the_target():
    features, q = Features(ARM, 14), sweep(40)[20]
    there = q + 0.01 * np.cos(np.arange(6))
    target = arm_model(ARM).pose(there)
    base, observation = features(q[None], np.repeat(target[None], 14, 0)[None], np.zeros((1, PAST_STEPS, 6)))
    assert observation.shape == (1, features.width)
    position, rotation = pose_distance(arm_model(ARM).pose(q + base[0]), target)
    assert position < 3e-4
    assert rotation < 3e-3


def test_numpy_answers_as_the_policy_does_and_half_precision_keeps_it(checkpoint, tmp_path):
    policy, folder = checkpoint
    small = load_weights(pack(folder, tmp_path / "packed").parent)
    exact, packed = Foresight.load(folder, ARM), Foresight(small)
    q = sweep(40)
    targets = np.stack([arm_model(ARM).pose(row) for row in sweep(40) + 0.01])
    policy.reset()
    exact.reset(q[0])
    packed.reset(q[0])
    for row, target in zip(q, targets, strict=True):
        wanted = policy.predict_joints(
            torch.tensor(row, dtype=torch.float32)[None], torch.tensor(target, dtype=torch.float32)[None]
        )[0].numpy()
        answer = exact(row, target)
        within = np.clip(answer, row - 0.1, row + 0.1)
        assert np.abs(np.clip(within, policy.features.lower, policy.features.upper) - wanted).max() < 1e-5
        assert np.abs(packed(row, target) - answer).max() < 2e-3


@pytest.mark.parametrize("objective", ["regression", "mip", "flow"])
def test_every_objective_trains_and_an_untrained_policy_goes_half_the_least_squares_step(objective):
    policy = ForesightPolicy(
        config(objective=objective, rollout_frames=200, fk_weight=0.1, fk_update="joint")
    )
    policy._motions, policy._fps = pieces(sweep(120), np.zeros(120)), 20.0
    policy.delta.fit(torch.full((6,), -0.1), torch.full((6,), 0.1))
    loss, log = policy.forward({"index": torch.arange(8)})
    loss.backward()
    assert torch.isfinite(loss)
    assert f"{objective}_loss" in log
    if objective == "regression":
        base, observation, *_ = policy._samples
        obs = torch.cat([base, observation], dim=-1)
        assert torch.allclose(
            policy.network(torch.zeros_like(base), 0.0, 0.0, obs) * 0.1, 0.5 * base, atol=1e-6
        )


def test_rollouts_are_a_function_of_their_seed_and_teach_the_way_back():
    features, motions = Features(ARM, 14), [sweep(60), sweep(30)]
    hand = Hand(fps=20.0, tremor_mm=0.0, steady=0.0, pace=1.0)

    def along(base, observation):
        return base  # the least squares step

    one, other = (drive(features, ARM, motions, along, hand, 0.0, np.random.default_rng(3)) for _ in range(2))
    assert all(np.array_equal(a, b) for a, b in zip(vars(one).values(), vars(other).values(), strict=True))
    # Without weight on the change, the best step goes to the clean motion itself.
    first = one.q[:2] + one.step[:2]
    assert np.allclose(first, [motions[0][0], motions[1][0]])
    assert len(one.q) == 90


def test_a_trembling_hand_is_told_from_a_steady_one():
    model, path = arm_model(ARM), sweep(80)
    clean = np.stack([model.pose(q) for q in path])
    found = {}
    for mm in (0.0, 1.0, 2.0):
        gauge = TremorGauge(14)
        for pose in displaced(clean, tremor(80, 20.0, 1.0, np.random.default_rng(0)) * mm):
            gauge.update(pose if mm < 2 else pose * np.array([1, 1, 1, -1, -1, -1, -1]))
        found[mm] = gauge.tremor
    # Within eight targets a tremor is known.
    gauge = TremorGauge(14)
    for pose in displaced(clean, tremor(80, 20.0, 1.0, np.random.default_rng(0)))[:8]:
        gauge.update(pose)
    assert 3e-4 < gauge.tremor[0] < 2e-3
    assert max(found[0.0]) < 2e-5
    assert 5e-4 < found[1.0][0] < 1.5e-3
    assert 1e-3 < found[2.0][0] < 3e-3
    assert 0.002 < found[1.0][1] < 0.014


class Liar:
    """Proposes nonsense under any tremor that it likes."""

    def __init__(self, tremor_m: float, joints: np.ndarray) -> None:
        self.tremor, self.joints = (tremor_m, 10.0 * tremor_m), joints

    def reset(self, q):
        pass

    def __call__(self, start, target):
        return self.joints


@pytest.mark.parametrize("joints", [HOME + 1.0, np.full(6, np.nan), np.full(6, 1e300)])
def test_no_foresight_moves_a_target_further_than_promised(joints):
    model = arm_model(ARM)
    settings = GuidanceSettings(foresight_radius=0.0015, foresight_angle=0.014)
    misled = Guidance(model, settings, foresight=Liar(1.0, joints))
    misled.reset(HOME)
    q = HOME
    for _ in range(20):
        q = misled.solve(q, model.pose(HOME)).q
    position, rotation = pose_distance(model.pose(q), model.pose(HOME))
    assert position < 0.00151
    assert rotation < 0.0141


def test_without_tremor_foresight_changes_nothing():
    model = arm_model(ARM)
    alone, beside = Guidance(model), Guidance(model, foresight=Liar(0.0, HOME + 0.3))
    alone.reset(HOME)
    beside.reset(HOME)
    target = model.pose(HOME + 0.02)
    assert np.allclose(alone.solve(HOME, target).q, beside.solve(HOME, target).q, atol=1e-9)


def test_damaged_weights_and_other_arms_are_refused(checkpoint, tmp_path):
    _, folder = checkpoint
    with pytest.raises(ValueError, match="another arm's"):
        Foresight.load(folder, describe_arm("piper"))
    with pytest.raises(FileNotFoundError, match="no foresight weights"):
        load_weights(tmp_path / "nothing")
    broken = pack(folder, tmp_path / "broken")
    broken.write_bytes(broken.read_bytes()[:500])
    with pytest.raises(ValueError, match="is damaged"):
        load_weights(broken.parent)


@pytest.mark.parametrize(
    ("tensor", "value", "message"),
    [
        ("mean", None, "mean is missing"),
        ("mean", np.zeros(1), "mean has shape"),
        ("scale", 0.0, "scale is not positive"),
        ("layers.0.bias", np.nan, "layers.0.bias is not finite"),
        ("layers.0.bias", np.zeros((1, 16)), "layers.0.bias has shape"),
        ("layers.2.weight", np.zeros((16, 16), dtype=np.int32), "layers.2.weight holds int32"),
        ("layers.9.weight", np.zeros((16, 16)), "layers.9.weight does not belong"),
        ("layers.x", np.zeros(1), "layers.x does not belong"),
    ],
)
def test_weights_load_strictly_and_what_is_wrong_is_named(checkpoint, tmp_path, tensor, value, message):
    file, name = pack(checkpoint[1], tmp_path), f"average.network.{tensor}"
    tensors = load_file(file)
    if value is None:
        del tensors[name]
    else:
        tensors[name] = np.full_like(tensors[name], value) if isinstance(value, float) else value
    save_file(tensors, file)
    with pytest.raises(ValueError, match=message):
        load_weights(tmp_path)


def test_tensors_that_are_no_policys_are_refused_by_name(checkpoint, tmp_path):
    file = pack(checkpoint[1], tmp_path)
    save_file(load_file(file) | {"payload": np.zeros(3)}, file)
    with pytest.raises(ValueError, match="payload does not belong"):
        load_weights(tmp_path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("n_obs_steps", 10**9),  # would take the memory
        ("n_obs_steps", None),
        ("n_obs_steps", 14.7),
        ("t_star", float("nan")),
        ("t_star", None),
        ("objective", "flow"),
        ("joint_names", [1, 2]),
        ("urdf", None),
    ],
)
def test_a_hostile_configuration_of_weights_is_refused_with_the_folder(checkpoint, tmp_path, key, value):
    pack(checkpoint[1], tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps(config | {key: value}))
    with pytest.raises(ValueError, match=tmp_path.name):
        load_weights(tmp_path)


@pytest.mark.parametrize("changes", [{"n_obs_steps": 4}, {"pace": 0.5}, {"steady": 1.0}, {"objective": "x"}])
def test_a_configuration_that_cannot_work_is_refused(changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        config(**changes)


def test_the_rounds_go_on_where_a_run_was_interrupted():
    policies = [ForesightPolicy(config(rollout_every=2, rollout_frames=100)) for _ in range(2)]
    policies[1].load_state_dict(policies[0].state_dict())
    for policy in policies:
        policy._motions, policy._fps = pieces(sweep(120), np.zeros(120)), 20.0
        policy.training_step.fill_(4)
    seen = [policy._rolled_out({"index": torch.arange(5)}) for policy in policies]
    assert all(torch.equal(a, b) for a, b in zip(*seen, strict=True))
    assert policies[0]._round == 2


def test_one_query_sees_what_many_at_once_see():
    features, rng = Features(ARM, 14), np.random.default_rng(0)
    q = sweep(40)[:5]
    poses = np.stack([arm_model(ARM).pose(row) for row in q + 0.02])
    targets = np.stack(
        [displaced(np.repeat(pose[None], 14, 0), rng.normal(size=(14, 6)) * 2e-3) for pose in poses]
    )
    steps = rng.normal(size=(5, PAST_STEPS, 6)) * 0.01
    together = features(q, targets, steps)
    for i in range(5):
        one = features(q[i : i + 1], targets[i : i + 1], steps[i : i + 1])
        assert all(np.allclose(a[0], b[i], atol=1e-6) for a, b in zip(one, together, strict=True))


@pytest.mark.parametrize("arm", shipped())
def test_the_weights_in_the_package_steady_a_trembling_hand_and_leave_a_calm_one(arm):
    adapters = MimicIKAdapter.from_pretrained(arm), MimicIKAdapter.for_arm(arm)
    home = np.array(adapters[0].description.home)
    t = np.linspace(0.0, 6.0, 200)[:, None]
    clean = np.stack([adapters[1].forward(q) for q in home + 0.15 * np.sin(t + np.arange(len(home)))])
    noise = np.random.default_rng(0).normal(size=(200, 6)) * ([6e-4] * 3 + [5e-3] * 3)
    shaken = displaced(clean, noise)

    def jerk(adapter, targets):
        adapter.reset()
        q, found = home, []
        for target in targets:
            q = adapter.solve(q, target).q
            found.append(q)
        return np.abs(np.diff(found, n=3, axis=0))[30:].mean()

    steady, plain = (jerk(adapter, shaken) for adapter in adapters)
    assert steady < 0.6 * plain
    assert jerk(adapters[0], clean) < 1.2 * jerk(adapters[1], clean)


def test_tables_measure_the_checkpoint_that_was_named_and_not_the_package(checkpoint, tmp_path, capsys):
    _, folder = checkpoint
    make_stress(tmp_path / "sets", ARM, kinds=["tremor-1mm"], episodes=1, seconds=2.0)
    data = tmp_path / "sets" / "tremor-1mm"
    rows = "--solvers=foresight,foresight_alone"

    def errors(command: str, dataset: str, *options: str) -> list[float]:
        out = tmp_path / f"{command}{len(options)}"
        common = [f"{dataset}={data}", rows, "--modes=closed_loop", f"--output={out}"]
        assert cli.main([command, *common, *options]) == 0
        found = json.loads((out / {"eval": "report.json", "bench": "summary.json"}[command]).read_text())
        return [row["mean_mm"] for row in found["rows"] if row["solver"].startswith("foresight")]

    for command, dataset in (("eval", "--dataset"), ("bench", "--datasets")):
        named = errors(command, dataset, f"--policy.path={folder}")
        assert len(named) == 2
        assert (np.abs(np.subtract(named, errors(command, dataset))) > 1e-3).all()
    options = [f"--datasets={data}", f"--policy.path={folder}", f"--output={tmp_path / 'x'}"]
    assert cli.main(["bench", *options, "--solvers=guided"]) != 0
    assert "no row of --solvers is measured with it" in capsys.readouterr().err
