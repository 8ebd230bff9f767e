"""Checkpoints on the Hub: the real client of huggingface_hub against a Hub on loopback."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from hub_contents import Hub
from hub_server import serve
from huggingface_hub import HfApi, ModelCard, constants
from huggingface_hub.errors import RepositoryNotFoundError
from lerobot.scripts import lerobot_train
from safetensors.torch import load_file, save_file
from teleop import write_teleop

from lerobot_mimicik.cli import eval as eval_command
from lerobot_mimicik.modeling_mimicik import MimicIKPolicy
from lerobot_mimicik.publishing.hub import find_report, read_report, weights_digest

TRAINED = "user/mimicik-test"
MEASURED = "user/mimicik-measured"


@pytest.fixture(scope="module")
def hub(tmp_path_factory):
    """A Hub that this process's client is logged in to as `user`."""
    with (
        serve({"hf_user": "user", "hf_stranger": "stranger"}) as served,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setattr(constants, "ENDPOINT", served.endpoint)
        patch.setattr(
            constants,
            "HUGGINGFACE_CO_URL_TEMPLATE",
            served.endpoint + "/{repo_id}/resolve/{revision}/{filename}",
        )
        patch.setattr(constants, "HF_HUB_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.setattr(constants, "HF_HUB_OFFLINE", False)
        patch.setattr(constants, "HF_HUB_DISABLE_XET", True)
        patch.setenv("HF_TOKEN", "hf_user")
        yield served


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return write_teleop(tmp_path_factory.mktemp("data") / "teleop", episodes=3, frames=20)


@pytest.fixture(scope="module")
def checkpoint(hub, root, tmp_path_factory) -> Path:
    """The folder of a checkpoint that `lerobot-train` has saved and pushed."""
    run = tmp_path_factory.mktemp("train") / "run"
    arguments = [
        "--policy.type=mimicik", "--policy.d_model=32", "--policy.n_layers=1", "--policy.n_heads=2",
        "--policy.d_ff=32", "--policy.device=cpu", "--policy.tool_offset=[0.1594,0,0]",
        "--policy.push_to_hub=true", f"--policy.repo_id={TRAINED}",
        "--dataset.repo_id=user/teleop", f"--dataset.root={root}", f"--output_dir={run}",
        "--steps=2", "--batch_size=8", "--num_workers=0", "--env_eval_freq=0", "--log_freq=1",
    ]  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["lerobot-train", *arguments])
        lerobot_train.main()
    return run / "checkpoints" / "last" / "pretrained_model"


@pytest.fixture(scope="module")
def report(checkpoint, root, tmp_path_factory) -> Path:
    """The folder of the checkpoint's evaluation."""
    out = tmp_path_factory.mktemp("eval")
    options = ["--mode=open_loop", "--episodes=0", "--latency_queries=2"]
    eval_command.main([f"--policy.path={checkpoint}", f"--dataset.root={root}", f"--out={out}", *options])
    return out


def card(hub: Hub, repo: str) -> ModelCard:
    return ModelCard(hub.repositories[repo].files["README.md"].content.decode())


def test_training_uploads_all_that_a_checkpoint_needs(hub, checkpoint):
    files = hub.repositories[TRAINED].files
    expected = {path.name for path in checkpoint.iterdir()}
    assert {
        "config.json",
        "model.safetensors",
        "policy_preprocessor.json",
        "policy_postprocessor.json",
    } < expected
    assert set(files) == {".gitattributes", "README.md", *expected}
    assert files["model.safetensors"].lfs
    assert files["model.safetensors"].content == (checkpoint / "model.safetensors").read_bytes()
    assert json.loads(files["config.json"].content)["urdf"].lstrip().startswith("<")


def test_card_of_a_training_says_that_nothing_was_measured(hub, checkpoint):
    found = card(hub, TRAINED)
    assert found.data.library_name == "lerobot"
    assert found.data.pipeline_tag == "robotics"
    assert {"mimicik", "inverse-kinematics", "robotics", "lerobot"} <= set(found.data.tags)
    assert found.data.datasets == ["user/teleop"]
    assert "No evaluation is recorded" in found.text
    assert f"mimicik eval --policy.path={TRAINED}" in found.text
    assert HfApi().model_info(TRAINED).card_data.license == "unknown"


def test_new_process_without_dataset_gives_the_same_commands(hub, checkpoint, tmp_path):
    policy = MimicIKPolicy.from_pretrained(checkpoint)
    generator = torch.Generator().manual_seed(0)
    q = 0.1 * torch.randn(5, 6, generator=generator) + torch.tensor([0.0, -1.2, 1.3, 1.6, -0.9, -1.6])
    ask = {"observation.state": q, "observation.ee_target": policy.arm.forward(q + 0.01)}
    save_file(ask, tmp_path / "ask.safetensors")
    client = {
        "HF_ENDPOINT": hub.endpoint,
        "HF_TOKEN": "hf_user",
        "HF_HOME": str(tmp_path / "home"),
        "HF_LEROBOT_HOME": str(tmp_path / "home"),
        "HF_HUB_DISABLE_XET": "1",
        "HF_HUB_OFFLINE": "0",
        "OMP_NUM_THREADS": "1",
        "ASK": str(tmp_path / "ask.safetensors"),
    }
    done = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("load_from_hub.py")), TRAINED],
        cwd=tmp_path, env=os.environ | client, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    answers = load_file(tmp_path / "ask.safetensors")
    expected = policy.predict_joints(*ask.values())
    torch.testing.assert_close(answers["joints"], expected, rtol=0, atol=0)
    torch.testing.assert_close(answers["action"], expected, rtol=0, atol=0)
    assert answers["example"].shape == (1, 6)


def test_push_from_a_folder_takes_processors_settings_and_evaluation_along(hub, checkpoint, report, tmp_path):
    folder = shutil.copytree(checkpoint, tmp_path / "pretrained_model")
    shutil.copytree(report, folder / "eval")
    MimicIKPolicy.from_pretrained(folder).push_to_hub(MEASURED, private=True)
    found, files = card(hub, MEASURED), hub.repositories[MEASURED].files
    assert set(files) == {*hub.repositories[TRAINED].files, "report.json", "singularity.gif"}
    rows = json.loads(files["report.json"].content)["rows"]
    for row in rows:
        assert f"| {row['solver']} | {row['mean_mm']:.3f} |" in found.text or row["mean_mm"] >= 100
    assert {row["solver"] for row in rows} == {"mimicik", "hold"}
    assert found.data.datasets == ["user/teleop"]
    with pytest.raises(RepositoryNotFoundError):
        HfApi(token="hf_stranger").model_info(MEASURED)

    # Further trained weights were never measured: neither the card nor the repository shows the old figures.
    policy = MimicIKPolicy.from_pretrained(MEASURED)
    with torch.no_grad():
        next(policy.network.parameters()).add_(1)
    policy.push_to_hub(MEASURED, picture=False)
    assert "No evaluation is recorded" in card(hub, MEASURED).text
    assert card(hub, MEASURED).data.datasets is None
    assert set(hub.repositories[MEASURED].files) == set(hub.repositories[TRAINED].files)


def test_push_without_a_folder_makes_the_processors(hub, checkpoint, report):
    policy = MimicIKPolicy.from_pretrained(checkpoint)
    policy.push_to_hub(
        "user/alone",
        source=None,
        report=report,
        picture=False,
        card_kwargs={"license": "mit", "tags": ["airbot"]},
    )
    files = hub.repositories["user/alone"].files
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        made, trained = json.loads(files[name].content), json.loads((checkpoint / name).read_bytes())
        assert [step["registry_name"] for step in made["steps"]] == [
            step["registry_name"] for step in trained["steps"]
        ]
    found = card(hub, "user/alone")
    assert (found.data.license, "airbot" in found.data.tags) == ("mit", True)
    assert "closed loop" in found.text.lower()


def test_pushing_again_from_a_checkpoint_loses_nothing(hub, checkpoint, report):
    """Neither from the folder that was trained nor from the Hub: picture, table, data, licence, tags, own words."""
    repo = "user/again"
    MimicIKPolicy.from_pretrained(checkpoint).push_to_hub(
        repo, report=report, card_kwargs={"license": "mit", "tags": ["airbot"]}
    )
    first = card(hub, repo)
    assert "MimicIKAdapter.from_pretrained" in first.text
    assert "3 episodes, 60 frames" in first.text
    assert "![airbot_play led through a singularity](singularity.gif)" in first.text
    assert first.text.count("| mimicik |") == 1
    first.content += "\nMy own words.\n"
    HfApi().upload_file(repo_id=repo, path_or_fileobj=str(first).encode(), path_in_repo="README.md")
    before = set(hub.repositories[repo].files)
    for source in (checkpoint, repo):
        MimicIKPolicy.from_pretrained(source).push_to_hub(repo)
        assert str(card(hub, repo)).split() == str(first).split()
        assert set(hub.repositories[repo].files) == before >= {"report.json", "singularity.gif"}


def test_report_of_other_weights_is_refused(hub, checkpoint, report):
    policy = MimicIKPolicy.from_pretrained(checkpoint)
    other = read_report(report)
    other["settings"]["weights"] = "0" * 64
    with pytest.raises(ValueError, match="other weights"):
        policy.push_to_hub("user/refused", report=other)
    assert "user/refused" not in hub.repositories


def test_report_of_a_run_counts_only_for_the_checkpoint_it_names(checkpoint, report, tmp_path):
    folder = shutil.copytree(checkpoint, tmp_path / "run" / "checkpoints" / "000002" / "pretrained_model")
    digest = weights_digest(load_file(folder / "model.safetensors"))
    found = read_report(report)
    for weights, expected in ((None, False), ("0" * 64, False), (digest, True)):
        found["settings"]["weights"] = weights
        (tmp_path / "run" / "eval").mkdir(exist_ok=True)
        (tmp_path / "run" / "eval" / "report.json").write_text(json.dumps(found))
        assert (find_report(folder, digest) is not None) is expected


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "is no report of `mimicik eval`"),
        ({"rows": [{"solver": "hold"}]}, "a row of hold lacks mode"),
        ("no json", "is not JSON"),
    ],
)
def test_unreadable_report_is_named(tmp_path, content, message):
    (tmp_path / "report.json").write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(ValueError, match=message):
        read_report(tmp_path)


@pytest.mark.parametrize(
    ("files", "error", "message"),
    [
        (None, FileNotFoundError, "user/broken"),
        ({"README.md": b"nothing here"}, FileNotFoundError, "config.json not found .* user/broken"),
        ({"config.json": b'{"architectures": ["Bert"]}'}, ValueError, "Missing 'type' .* user/broken"),
        ({"config.json": b'{"type": "act"}'}, TypeError, "expected a policy of type 'mimicik', got 'act'"),
    ],
)
def test_what_is_no_checkpoint_is_named(hub, tmp_path, files, error, message):
    hub.repositories.pop("user/broken", None)
    if files is not None:
        api = HfApi()
        api.create_repo("user/broken")
        for path, content in files.items():
            api.upload_file(repo_id="user/broken", path_or_fileobj=content, path_in_repo=path)
    with pytest.raises(error, match=message):
        MimicIKPolicy.from_pretrained("user/broken", cache_dir=tmp_path)


def test_source_that_is_no_checkpoint_is_named(hub, checkpoint, tmp_path):
    policy = MimicIKPolicy.from_pretrained(checkpoint)
    for source in (tmp_path, "user/does-not-exist"):
        with pytest.raises(FileNotFoundError, match="source"):
            policy.push_to_hub("user/refused", source=source)


def test_foresight_is_published_and_steadies_an_adapter_of_the_hub(hub):
    from lerobot_mimicik.configuration_foresight import ForesightConfig
    from lerobot_mimicik.modeling_foresight import ForesightPolicy
    from robot_adapters.adapter import IKStatus, MimicIKAdapter

    policy = ForesightPolicy(ForesightConfig(urdf="airbot_play", hidden_dim=8, n_layers=1, device="cpu"))
    policy.delta.fit(-torch.ones(6), torch.ones(6))
    policy.push_to_hub("user/steady", picture=False)
    assert "# MimicIK foresight for airbot_play" in card(hub, "user/steady").content
    adapter = MimicIKAdapter.from_pretrained("user/steady")
    q = torch.tensor([0.0, -1.2, 1.3, 1.6, -0.9, -1.6]).double().numpy()
    assert adapter.solve(q, adapter.forward(q)).status == IKStatus.REACHED
