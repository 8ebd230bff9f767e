"""Checkpoints load strictly, and damage is one line with the reason in every command."""

import json
import shutil

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from safetensors.torch import load_file, save_file

from lerobot_mimicik import outputs
from lerobot_mimicik.baselines.configuration_mlp import MLPConfig
from lerobot_mimicik.baselines.modeling_mlp import MLPPolicy
from lerobot_mimicik.checkpoints import load_policy
from lerobot_mimicik.cli import main as cli
from lerobot_mimicik.configuration_mimicik import MimicIKConfig
from lerobot_mimicik.data.writer import Episode, write_dataset
from lerobot_mimicik.kinematics.arms import describe_arm
from lerobot_mimicik.kinematics.array_chain import array_chain
from lerobot_mimicik.modeling_mimicik import MimicIKPolicy
from lerobot_mimicik.weights import CheckpointError
from robot_adapters.processor_steps import EEActionToJoints
from robot_adapters.wrapping import wrap_checkpoint

SIZES = {"d_model": 16, "n_layers": 1, "n_heads": 2, "d_ff": 16}


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """The folder of a small checkpoint that nothing is wrong with."""
    folder = tmp_path_factory.mktemp("sound") / "policy"
    MLPPolicy(MLPConfig(device="cpu", hidden_dim=8, n_layers=1)).save_pretrained(folder)
    return folder


@pytest.fixture
def checkpoint(sound, tmp_path):
    return shutil.copytree(sound, tmp_path / "policy")


def change_weights(folder, change):
    file = folder / "model.safetensors"
    tensors = load_file(file)
    change(tensors)
    save_file(tensors, file)


def change_config(folder, **changes):
    file = folder / "config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def test_a_sound_checkpoint_loads_bit_for_bit(checkpoint):
    loaded = load_policy(str(checkpoint)).state_dict()
    saved = load_file(checkpoint / "model.safetensors")
    assert loaded.keys() == saved.keys()
    assert all(torch.equal(loaded[name], saved[name]) for name in saved)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda t: t.pop("delta.upper"), r"delta\.upper is missing"),
        (lambda t: t.update(extra=torch.zeros(2)), "extra does not belong"),
        (
            lambda t: t.update({"delta.lower": torch.zeros(7)}),
            r"delta\.lower has shape \(7,\), expected \(6,\)",
        ),
        (lambda t: t["delta.lower"].fill_(torch.nan), r"delta\.lower is not finite"),
        (lambda t: t.update({"delta.lower": torch.zeros(6, dtype=torch.int64)}), "holds torch.int64"),
        (lambda t: t["delta.lower"].fill_(9.0), r"delta\.lower exceeds delta\.upper"),
        (lambda t: [t.pop(name) for name in list(t)[1:]], "is missing; .* and [0-9]+ more faults"),
    ],
)
def test_other_tensors_than_those_of_the_configuration_are_refused_by_name(checkpoint, change, reason):
    change_weights(checkpoint, change)
    with pytest.raises(CheckpointError, match=rf"model\.safetensors: .*{reason}"):
        load_policy(str(checkpoint))
    with pytest.raises(CheckpointError, match=reason):  # LeRobot's way, as lerobot-rollout goes it
        MLPPolicy.from_pretrained(checkpoint)


def truncate(folder):
    file = folder / "model.safetensors"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


DAMAGE = {
    "truncated": (truncate, "model.safetensors is damaged"),
    "empty": (lambda folder: (folder / "model.safetensors").write_bytes(b""), "model.safetensors is damaged"),
    "garbage": (lambda folder: (folder / "model.safetensors").write_bytes(b"x" * 99), "is damaged"),
    "no weights": (lambda folder: (folder / "model.safetensors").unlink(), "has no weights"),
    "list": (lambda folder: (folder / "config.json").write_text("[]"), "expected an object with a type"),
    "no JSON": (lambda folder: (folder / "config.json").write_text("{"), "config.json is damaged"),
    "deep": (lambda folder: (folder / "config.json").write_text("[" * 200_000), "config.json is damaged"),
    "binary": (lambda folder: (folder / "config.json").write_bytes(b"\xff\xfe"), "config.json is damaged"),
    "key": (lambda folder: change_config(folder, colour="red"), "`colour` are not valid"),
    "value": (lambda folder: change_config(folder, conditioning="x"), "conditioning='x': expected one of"),
    "null": (lambda folder: change_config(folder, n_layers=None), "n_layers=None: expected a whole number"),
    "size": (lambda folder: change_config(folder, n_obs_steps=100_000), "n_obs_steps=100000"),
    "type": (lambda folder: change_config(folder, type="gpt"), "'gpt'"),
    "URDF": (lambda folder: change_config(folder, urdf="<robot>"), "not well-formed XML"),
    "no arm": (lambda folder: change_config(folder, urdf="<robot name='r'/>"), "has no links"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_checkpoint_is_told_in_a_line_and_found_by_the_doctor(
    checkpoint, damage, capsys, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)  # deploy claims its output there
    monkeypatch.delenv("MIMICIK_TRACEBACK", raising=False)
    inflict, reason = DAMAGE[damage]
    inflict(checkpoint)
    commands = (
        ["serve", "--bind=tcp://127.0.0.1:0"],
        ["deploy", "--interface=virtual"],
    )
    for command, *options in commands:
        assert cli.main([command, f"--policy.path={checkpoint}", *options]) == 1
        shown = capsys.readouterr().err
        assert shown.startswith(f"mimicik {command}: ")
        assert reason in shown
        assert str(checkpoint) in shown
    assert cli.main(["doctor", f"--policy.path={checkpoint}"]) == 1
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("FAILED"))
    assert line.startswith("FAILED  checkpoint: ")
    assert reason in line


@pytest.fixture(scope="module")
def tiny_set(tmp_path_factory):
    """The folder of a dataset of three frames at rest."""
    arm, root = describe_arm("airbot_play"), tmp_path_factory.mktemp("tiny") / "set"
    q = np.tile(arm.home, (3, 1))
    pose = array_chain(arm).pose(q)
    write_dataset(root, "local/set", [Episode(q, q, pose, pose, "wait", "s")], arm)
    return root


def told(capsys, monkeypatch, command, *options):
    """What a command that fails says on stderr: one line, and where to ask for more."""
    monkeypatch.delenv("MIMICIK_TRACEBACK", raising=False)
    assert cli.main([command, *options]) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith(f"mimicik {command}: ")]
    assert len(lines) == 1
    return lines[0]


@pytest.mark.parametrize("damage", DAMAGE)
def test_eval_tells_a_damaged_checkpoint_in_a_line(
    checkpoint, tiny_set, tmp_path, damage, capsys, monkeypatch
):
    inflict, reason = DAMAGE[damage]
    inflict(checkpoint)
    options = [f"--policy.path={checkpoint}", f"--dataset.root={tiny_set}", f"--output={tmp_path / 'out'}"]
    shown = told(capsys, monkeypatch, "eval", *options)
    assert reason in shown
    assert str(checkpoint) in shown


@pytest.mark.parametrize("damage", ["truncated", "no weights", "no JSON", "key", "null", "URDF"])
def test_bench_tells_a_damaged_training_in_a_line(sound, tiny_set, tmp_path, damage, capsys, monkeypatch):
    inflict, reason = DAMAGE[damage]
    checkpoints = tmp_path / "out" / "train" / "mlp-seed0" / "run" / "checkpoints"
    shutil.copytree(sound, checkpoints / "000001" / "pretrained_model")
    (checkpoints / "last").symlink_to("000001")
    outputs.mark(tmp_path / "out", "benchmark")
    inflict(checkpoints / "000001" / "pretrained_model")
    options = [f"--datasets={tiny_set}", f"--train={tiny_set}", "--solvers=mlp", "--steps=1"]
    shown = told(capsys, monkeypatch, "bench", *options, f"--output={tmp_path / 'out'}")
    assert reason in shown
    assert str(checkpoints) in shown


@pytest.fixture(scope="module")
def act(tmp_path_factory):
    """The folder of an untrained end-effector policy, with its processors."""
    folder = tmp_path_factory.mktemp("act") / "policy"
    numbers = {"mean": torch.zeros(8), "std": torch.ones(8)}
    inputs = {
        "observation.state": PolicyFeature(FeatureType.STATE, (8,)),
        "observation.environment_state": PolicyFeature(FeatureType.ENV, (8,)),
    }
    config = ACTConfig(
        input_features=inputs,
        output_features={"action": PolicyFeature(FeatureType.ACTION, (8,))},
        **{"device": "cpu", "push_to_hub": False, "use_vae": False, "chunk_size": 4, "n_action_steps": 4},
        **{
            "dim_model": 16,
            "n_heads": 2,
            "dim_feedforward": 16,
            "n_encoder_layers": 1,
            "n_decoder_layers": 1,
        },
    )
    ACTPolicy(config).save_pretrained(folder)
    statistics = dict.fromkeys([*inputs, "action"], numbers)
    for pipeline in make_pre_post_processors(config, dataset_stats=statistics):
        pipeline.save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def ik(tmp_path_factory):
    """The folder of an untrained MimicIK policy."""
    folder = tmp_path_factory.mktemp("ik") / "policy"
    MimicIKPolicy(MimicIKConfig(device="cpu", **SIZES)).save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def wrapped(act, ik, tmp_path_factory):
    return wrap_checkpoint(str(act), str(ik), tmp_path_factory.mktemp("wrapped") / "policy")


PRE, POST = "policy_preprocessor.json", "policy_postprocessor.json"
SOURCE_DAMAGE = {
    "list": DAMAGE["list"],
    "no JSON": DAMAGE["no JSON"],
    "binary": DAMAGE["binary"],
    "key": DAMAGE["key"],
    "type": (lambda folder: change_config(folder, type="gpt"), "'gpt'"),
    "no features": (lambda folder: change_config(folder, output_features={}), "an action of no numbers"),
    "features": (lambda folder: change_config(folder, output_features=5), "output_features"),
    "weights": (truncate, "model.safetensors is damaged"),
    "no weights": (lambda folder: (folder / "model.safetensors").unlink(), "has no weights"),
    "processor": (lambda folder: (folder / PRE).write_text("{"), "processors of"),
    "processor list": (lambda folder: (folder / PRE).write_text("[]"), "processors of"),
    "processor binary": (lambda folder: (folder / PRE).write_bytes(b"\xff\xfe"), "processors of"),
    "no processor": (lambda folder: (folder / PRE).unlink(), "processors of"),
    "step": (lambda f: (f / PRE).write_text('{"name": "x", "steps": [{"registry_name": "nope"}]}'), "nope"),
}


@pytest.mark.parametrize("damage", SOURCE_DAMAGE)
def test_wrap_tells_a_damaged_policy_in_a_line_and_writes_nothing(
    act, ik, tmp_path, damage, capsys, monkeypatch
):
    folder = shutil.copytree(act, tmp_path / "act")
    inflict, reason = SOURCE_DAMAGE[damage]
    inflict(folder)
    options = [f"--policy.path={folder}", f"--ik.path={ik}", f"--output={tmp_path / 'out'}"]
    shown = told(capsys, monkeypatch, "wrap", *options)
    assert reason in shown
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "damage", ["truncated", "empty", "no weights", "list", "deep", "key", "size", "URDF"]
)
def test_wrap_tells_a_damaged_inverse_kinematics_in_a_line(act, ik, tmp_path, damage, capsys, monkeypatch):
    folder = shutil.copytree(ik, tmp_path / "ik")
    inflict, reason = DAMAGE[damage]
    inflict(folder)
    options = [f"--policy.path={act}", f"--ik.path={folder}", f"--output={tmp_path / 'out'}"]
    shown = told(capsys, monkeypatch, "wrap", *options)
    assert reason in shown
    assert str(folder) in shown
    assert not (tmp_path / "out").exists()


def change_step(folder, file, **changes):
    """Change the configuration of our step in a pipeline; an ellipsis leaves an entry out."""
    content = json.loads((folder / file).read_text())
    (step,) = (step for step in content["steps"] if step.get("class", "").startswith("robot_adapters"))
    step["config"] = {name: value for name, value in (step["config"] | changes).items() if value is not ...}
    (folder / file).write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("file", "changes", "reason"),
    [
        (POST, {"policy": ...}, "missing 1 required .* 'policy'"),
        (POST, {"joint_units": ...}, "missing 1 required .* 'joint_units'"),
        (POST, {"colour": "red"}, "unexpected keyword argument 'colour'"),
        (POST, {"policy": None}, "policy=None: expected the entries of a MimicIK configuration"),
        (POST, {"policy": {"colour": "red"}}, "unexpected keyword argument 'colour'"),
        (POST, {"policy": {"n_layers": 10**9}}, "n_layers=1000000000: expected 1 to"),
        (POST, {"policy": {"urdf": "<robot>"}}, "not well-formed XML"),
        (POST, {"settings": {"max_step": 1e999}}, "max_step must be finite"),
        (POST, {"settings": {"max_step": "wide"}}, "max_step='wide': expected a number"),
        (POST, {"settings": {"horizon": 10**12}}, "horizon=1000000000000: expected at most"),
        (POST, {"settings": [1]}, r"settings=\[1\]: expected names and values"),
        (POST, {"tool": [float("nan")] * 7}, "is no rotation"),
        (POST, {"tool": [0, 0]}, "expected poses of 7 numbers"),
        (POST, {"rotation": 5}, "5 is no pose format"),
        (PRE, {"arm": ...}, "missing 1 required .* 'arm'"),
        (PRE, {"arm": "{"}, "arm: expected an arm's description as JSON"),
        (PRE, {"arm": 5}, "arm: expected an arm's description as JSON"),
        (PRE, {"joint_units": "turns"}, "joint_units='turns'"),
        (PRE, {"state_keys": 5}, "state_keys=5: expected observation.state"),
        (PRE, {"state_keys": ["feeling"]}, "state_keys=.*: expected observation.state"),
    ],
)
def test_a_wrapped_checkpoint_with_a_damaged_processor_is_refused_with_the_reason(
    wrapped, tmp_path, file, changes, reason
):
    folder = shutil.copytree(wrapped, tmp_path / "policy")
    config = PreTrainedConfig.from_pretrained(folder)
    make_pre_post_processors(config, pretrained_path=str(folder))
    change_step(folder, file, **changes)
    with pytest.raises(
        ValueError, match=rf"Error: (.|\n)*{reason}"
    ):  # LeRobot's, which lerobot-rollout ends with
        make_pre_post_processors(config, pretrained_path=str(folder))


def test_wrapped_weights_load_strictly_too():
    step = EEActionToJoints(policy={"device": "cpu", **SIZES}, joint_units="rad")
    sound = step.state_dict()
    step.load_state_dict(sound)
    with pytest.raises(CheckpointError, match=r"delta\.upper is missing"):
        step.load_state_dict({name: value for name, value in sound.items() if name != "delta.upper"})
    with pytest.raises(CheckpointError, match=r"delta\.upper is not finite"):
        step.load_state_dict(sound | {"delta.upper": torch.full((6,), torch.nan)})


def test_pickles_are_not_read(checkpoint):
    class Trap:
        def __reduce__(self):
            return (pytest.fail, ("a pickle was loaded",))

    weights = checkpoint / "model.safetensors"
    for name in ("pytorch_model.bin", "model.safetensors"):
        weights.unlink(missing_ok=True)
        torch.save({"x": Trap()}, checkpoint / name)
        with pytest.raises(CheckpointError):
            load_policy(str(checkpoint))


@pytest.mark.parametrize("device", ["gpu", "cuda:x", "cpu:0 ", "cuda:99", ""])
def test_a_wrong_device_is_named(checkpoint, device):
    with pytest.raises(ValueError, match=rf"device='{device}'"):
        load_policy(str(checkpoint), device)
