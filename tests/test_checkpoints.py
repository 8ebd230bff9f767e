"""Checkpoints load strictly, and damage is one line with the reason in every command."""

import json
import shutil

import pytest
import torch
from safetensors.torch import load_file, save_file

from lerobot_mimicik.baselines.configuration_mlp import MLPConfig
from lerobot_mimicik.baselines.modeling_mlp import MLPPolicy
from lerobot_mimicik.checkpoints import load_policy
from lerobot_mimicik.cli import main as cli
from lerobot_mimicik.weights import CheckpointError


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
    checkpoint, damage, capsys, monkeypatch
):
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


def test_wrapped_weights_load_strictly_too():
    from robot_adapters.processor_steps import EEActionToJoints

    sizes = {"d_model": 16, "n_layers": 1, "n_heads": 2, "d_ff": 16}
    step = EEActionToJoints(policy={"device": "cpu", **sizes}, joint_units="rad")
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
