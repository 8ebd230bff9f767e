"""A policy in one ONNX file answers as the policy does, and what would not is refused."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest
import torch

pytest.importorskip("onnxruntime")
onnx = pytest.importorskip("onnx")

from lerobot_mimicik.baselines.configuration_mlp import MLPConfig  # noqa: E402
from lerobot_mimicik.baselines.configuration_unet import UNetConfig  # noqa: E402
from lerobot_mimicik.baselines.modeling_mlp import MLPPolicy  # noqa: E402
from lerobot_mimicik.baselines.modeling_unet import UNetPolicy  # noqa: E402
from lerobot_mimicik.cli.main import main  # noqa: E402
from lerobot_mimicik.configuration_mimicik import MimicIKConfig  # noqa: E402
from lerobot_mimicik.inference.engines import make_engine  # noqa: E402
from lerobot_mimicik.inference.onnx_export import write  # noqa: E402
from lerobot_mimicik.inference.onnx_file import StepFile  # noqa: E402
from lerobot_mimicik.modeling_mimicik import MimicIKPolicy  # noqa: E402
from lerobot_mimicik.solvers.exported import ExportedSolver  # noqa: E402
from lerobot_mimicik.solvers.mimicik import MimicIKSolver  # noqa: E402
from robot_adapters.adapter import MimicIKAdapter  # noqa: E402

TINY = {"d_model": 16, "n_layers": 2, "n_heads": 2, "d_ff": 32}


def moved(policy, seed=0):
    """The policy with weights that do something, in memory."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for network in (policy.network, policy.average.network):
            for parameter in network.parameters():
                parameter.normal_(std=0.05, generator=generator)
    return policy.eval()


def mip(seed=0, **changes):
    return moved(MimicIKPolicy(MimicIKConfig(**TINY | changes, device="cpu")), seed)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "arm.onnx"
    write(mip(), path)
    return path


@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda: mip(objective="flow", flow_steps=2), id="flow"),
        pytest.param(lambda: mip(objective="regression", conditioning="paper"), id="regression"),
        pytest.param(lambda: moved(MLPPolicy(MLPConfig(hidden_dim=16, n_layers=1, device="cpu"))), id="mlp"),
        pytest.param(
            lambda: moved(
                UNetPolicy(
                    UNetConfig(
                        channels=[16], condition_dim=8, inference_steps=2, train_timesteps=4, device="cpu"
                    )
                )
            ),
            id="unet",
        ),
    ],
)
def test_every_learned_kind_is_exported_as_it_answers(make, tmp_path):
    policy = make()
    assert write(policy, tmp_path / "x.onnx") <= 1e-5
    assert make_engine(policy, str(tmp_path / "x.onnx"))[0].endswith("x.onnx")


def test_solver_of_a_file_answers_along_a_motion_as_the_policys(file):
    policy = mip()
    exported, own = ExportedSolver(file), MimicIKSolver(policy.arm, policy, engine="eager")
    q = np.full(6, 0.1)
    exported.reset(q), own.reset(q)
    for _ in range(3):
        target = policy.arm.forward(torch.as_tensor(q + 0.02, dtype=torch.float32)).double().numpy()
        answer = exported.solve(q, target)
        np.testing.assert_allclose(answer, own.solve(q, target), atol=1e-5)
        exported = pickle.loads(pickle.dumps(exported))  # as for another process: its history goes along
        q = answer


def test_file_says_for_which_arm_it_is(file):
    told = {each.key: each.value for each in onnx.load(file).metadata_props}
    policy = mip()
    assert json.loads(told["joint_names"]) == list(policy.arm.joint_names)
    np.testing.assert_allclose(json.loads(told["joint_upper"]), policy.arm.upper, atol=1e-6)
    assert told["policy_type"] == "mimicik"
    assert len(told["urdf_sha256"]) == 64
    assert StepFile.load(file).facts.description == policy.config.arm_description()


def test_adapter_of_a_file_reaches_its_targets(file):
    adapter = MimicIKAdapter.from_pretrained(file)
    q = np.array([0.0, -0.6, 0.9, 1.2, -0.5, 0.1])
    assert adapter.solve(q, adapter.forward(q + 0.01)).status == "reached"
    assert adapter.solver.name == "mimicik"


def test_file_of_other_weights_is_refused_as_an_engine(file):
    with pytest.raises(ValueError, match=r"disagrees with the policy by .* rad"):
        make_engine(mip(seed=1), str(file))
    with pytest.raises(ValueError, match=r"frames of history are 2, expected 3"):
        make_engine(mip(n_obs_steps=3), str(file))


def changed(file, path, **props):
    model = onnx.load(file)
    told = {each.key: each.value for each in model.metadata_props} | props
    onnx.helper.set_model_props(model, {key: value for key, value in told.items() if value})
    onnx.save(model, path)
    return path


def test_file_that_was_changed_is_refused(file, tmp_path):
    model = onnx.load(file)
    weights = max(model.graph.initializer, key=lambda each: len(each.raw_data))
    weights.raw_data = (np.frombuffer(weights.raw_data, np.float32) * 1.01).tobytes()
    onnx.save(model, tmp_path / "weights.onnx")
    with pytest.raises(ValueError, match="disagrees with the policy that it was made from"):
        StepFile.load(tmp_path / "weights.onnx")
    (tmp_path / "half.onnx").write_bytes(file.read_bytes()[:5000])
    with pytest.raises(ValueError, match=r"half.onnx: ONNX Runtime .* cannot run it"):
        MimicIKAdapter.from_pretrained(tmp_path / "half.onnx")
    for props, match in (
        ({"mimicik": ""}, "was not made by `mimicik export`"),
        ({"urdf_sha256": "0" * 64}, "not the one whose hash it has"),
        ({"arm": "{}"}, "is damaged"),
        ({"history": "3"}, "is damaged"),
    ):
        with pytest.raises(ValueError, match=match):
            StepFile.load(changed(file, tmp_path / "x.onnx", **props))
    with pytest.raises(FileNotFoundError, match=r"expected a file of `mimicik export`"):
        StepFile.load(tmp_path / "missing.onnx")


def test_command_exports_a_checkpoint_and_refuses_what_it_cannot(tmp_path, capsys):
    mip().save_pretrained(tmp_path / "checkpoint")
    out = tmp_path / "arm.onnx"
    for _ in range(2):  # its own file is replaced
        assert main(["export", f"--policy.path={tmp_path / 'checkpoint'}", f"--output={out}"]) == 0
    assert "rad of the policy" in capsys.readouterr().out
    StepFile.load(out)
    (tmp_path / "mine.onnx").write_text("notes")
    for arguments, message in (
        (["--policy.path=airbot_play", f"--output={out}"], "foresight, which is not exported"),
        ([f"--policy.path={tmp_path / 'checkpoint'}", "--output=x.bin"], "ends with .onnx"),
        (
            [f"--policy.path={tmp_path / 'checkpoint'}", f"--output={tmp_path / 'mine.onnx'}"],
            "is not replaced",
        ),
        ([f"--policy.path={out}", f"--output={out}"], "is a file, a checkpoint is a folder"),
        (["--output=x.onnx"], "--policy.path (a checkpoint) and --output"),
    ):
        assert main(["export", *arguments]) == 1
        assert message in capsys.readouterr().err
