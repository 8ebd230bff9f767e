"""Publishing a checkpoint: policy, processors, training settings, card and evaluation in one commit.

An evaluation belongs to the weights it measured. A report that names the weights (`weights_digest`) is shown
only with these; a report that names none is taken from the checkpoint's own folder or from the caller.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import torch
from huggingface_hub import CommitInfo, HfApi, ModelCard, hf_hub_download, snapshot_download
from huggingface_hub.constants import CONFIG_NAME, REPOCARD_NAME, SAFETENSORS_SINGLE_FILE
from huggingface_hub.errors import EntryNotFoundError, HFValidationError, RepositoryNotFoundError
from safetensors.torch import load_file
from torch import Tensor

from lerobot_mimicik.publishing.model_card import KEPT_BELOW, TAGS, model_card
from lerobot_mimicik.publishing.training_facts import TrainingFacts

if TYPE_CHECKING:
    from lerobot.configs.train import TrainPipelineConfig
    from lerobot.datasets import LeRobotDatasetMetadata

    from lerobot_mimicik.evaluation.animation import Animation
    from lerobot_mimicik.modeling_learned import LearnedIKPolicy

REPORT_NAME = "report.json"
PICTURE_NAME = "singularity.gif"
_CHECKPOINT_FILES = ["*.json", "*.safetensors"]
_REPORT_PLACES = (REPORT_NAME, f"eval/{REPORT_NAME}")
# <run>/checkpoints/<step>/pretrained_model
_RUN_ABOVE_CHECKPOINT = 2


def weights_digest(state: Mapping[str, Tensor]) -> str:
    """SHA-256 over a policy's `state_dict()`, which is what its `model.safetensors` holds."""
    digest = hashlib.sha256()
    for name, value in sorted(state.items()):
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}\n".encode())
        digest.update(value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def read_report(path: str | Path) -> dict[str, Any]:
    """A report of `mimicik eval`, given `report.json` or the folder it is in.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If it is no such report.
    """
    from lerobot_mimicik.evaluation.report import ROW_KEYS

    path = Path(path)
    file = path / REPORT_NAME if path.is_dir() else path
    if not file.is_file():
        raise FileNotFoundError(
            f"{file} does not exist: expected the report that `mimicik eval --output=` writes"
        )
    try:
        report = json.loads(file.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise ValueError(f"{file} is not JSON: {error}") from error
    rows = report.get("rows") if isinstance(report, dict) else None
    if not isinstance(rows, list) or not rows:
        raise ValueError(f"{file} is no report of `mimicik eval`: it has no rows")
    for row in rows:
        missing = [key for key in ROW_KEYS if key not in row]
        if missing:
            raise ValueError(f"{file}: a row of {row.get('solver', 'a solver')} lacks {', '.join(missing)}")
    return report


def find_report(folder: str | Path, digest: str) -> dict[str, Any] | None:
    """The report of a checkpoint's weights: in its folder, in `eval` there, or in its training run.

    Args:
        folder: The checkpoint's folder.
        digest: `weights_digest` of the policy that the report must be about.

    Raises:
        ValueError: If a file called `report.json` there is no report.
    """
    folder = Path(folder).resolve()
    places = [folder / place for place in _REPORT_PLACES]
    if folder.parent.parent.name == "checkpoints":
        places += [folder.parents[_RUN_ABOVE_CHECKPOINT] / place for place in _REPORT_PLACES]
    for file in places:
        if file.is_file():
            report = read_report(file)
            measured = _measured_weights(report)
            # A run has many checkpoints: a report there that does not say which one it measured says nothing.
            if measured is None and folder in file.parents:
                measured = _digest_of(folder)
            if measured == digest:
                return report
    return None


def card_after_training(
    policy: LearnedIKPolicy,
    dataset_repo_id: str | None,
    license: str | None,
    tags: list[str] | None,
    cfg: TrainPipelineConfig | None,
    meta: LeRobotDatasetMetadata | None,
) -> ModelCard:
    """The card of weights that were trained a moment ago: nothing has measured them yet."""
    facts = replace(
        TrainingFacts() if meta is None else TrainingFacts.of_dataset(meta),
        dataset=dataset_repo_id,
        batch_size=None if cfg is None else cfg.batch_size,
        seed=None if cfg is None else cfg.seed,
    )
    return model_card(policy, policy.config.repo_id, facts, license=license, tags=tags)


def push_policy(
    policy: LearnedIKPolicy,
    repo_id: str,
    *,
    source: str | Path | None = None,
    report: str | Path | Mapping[str, Any] | None = None,
    picture: bool = True,
    commit_message: str | None = None,
    private: bool | None = None,
    token: str | None = None,
    branch: str | None = None,
    create_pr: bool | None = None,
    allow_patterns: list[str] | str | None = None,
    ignore_patterns: list[str] | str | None = None,
    delete_patterns: list[str] | str | None = None,
    card_kwargs: Mapping[str, Any] | None = None,
) -> CommitInfo:
    """Uploads a policy with its processors, its model card and picture and, where there is one, its evaluation.

    What the repository holds already is not lost: its evaluation, where it is of these weights, its licence and tags, and
    what somebody wrote below the card's last line.

    Args:
        policy: What is uploaded.
        repo_id: A Hub repository, `user/name`; made where it does not exist.
        source: The folder or Hub repository the policy was loaded from: its processors and training settings
            go along, and its evaluation is found. Without it, processors are made from the configuration.
        report: `report.json` of `mimicik eval` for these weights, its folder, or its content.
        picture: Whether the arm is drawn as it is led through a singularity.
        card_kwargs: Passed to `model_card`: `license`, `tags`, `training`.
        commit_message, private, token, branch, create_pr, allow_patterns, ignore_patterns, delete_patterns:
            as in LeRobot's `push_to_hub`.

    Raises:
        FileNotFoundError: If `source` or `report` does not exist.
        ValueError: If the report is none, or is one of other weights.
        huggingface_hub.errors.HfHubHTTPError: What the Hub refuses.
    """
    digest = weights_digest(policy.state_dict())
    folder = None if source is None else _checkpoint_folder(source, token)
    evaluation = _given_report(report, digest)
    if evaluation is None and folder is not None:
        evaluation = find_report(folder, digest)
    there = _Published.find(repo_id, digest, token)
    evaluation = there.report if evaluation is None else evaluation
    card_options: dict[str, Any] = {
        "training": _recorded_training(folder, digest),
        "license": policy.config.license or there.license,
        "tags": [*(policy.config.tags or ()), *there.tags],
        **(card_kwargs or {}),
    }
    # So that whoever loads the checkpoint and pushes it again need not know them.
    policy.config.license, policy.config.tags = (
        card_options["license"],
        list(card_options["tags"] or ()) or None,
    )
    drawn = _picture(policy) if picture else None
    card = model_card(
        policy, repo_id, report=evaluation, picture=None if drawn is None else drawn.caption, **card_options
    )
    if there.notes:
        card.content = f"{card.content.rstrip()}\n\n{there.notes}\n"

    api = HfApi(token=token)
    with TemporaryDirectory(ignore_cleanup_errors=True) as temporary:
        out = Path(temporary)
        policy.save_pretrained(out)
        _write_processors(policy, folder, out)
        card.save(out / REPOCARD_NAME)
        if drawn is not None:
            drawn.save(out)
        deleted = [delete_patterns] if isinstance(delete_patterns, str) else list(delete_patterns or ())
        if evaluation is None:
            deleted.append(REPORT_NAME)  # of an earlier push: it is not about these weights
        else:
            (out / REPORT_NAME).write_text(json.dumps(evaluation, indent=2) + "\n", encoding="utf-8")
        if drawn is None:
            deleted.append(PICTURE_NAME)
        repo_id = api.create_repo(repo_id=repo_id, private=private, exist_ok=True).repo_id
        return api.upload_folder(
            repo_id=repo_id,
            repo_type="model",
            folder_path=out,
            commit_message=commit_message or "Upload policy",
            revision=branch,
            create_pr=create_pr,
            allow_patterns=allow_patterns,
            ignore_patterns=ignore_patterns,
            delete_patterns=deleted or None,
        )


@dataclass(frozen=True)
class _Published:
    """What a repository holds already that a new push must not lose."""

    report: Mapping[str, Any] | None = None
    license: str | None = None
    tags: tuple[str, ...] = ()
    notes: str = ""

    @classmethod
    def find(cls, repo_id: str, digest: str, token: str | None) -> _Published:
        """What a repository holds; nothing for one that does not exist.

        Args:
            repo_id: The repository.
            digest: Of the weights that are pushed: an evaluation of others is not kept.
            token: Of the Hub.
        """
        report, card = None, None
        with suppress(EntryNotFoundError, RepositoryNotFoundError, ValueError):
            found = read_report(hf_hub_download(repo_id, REPORT_NAME, token=token))
            report = found if _measured_weights(found) == digest else None
        with suppress(EntryNotFoundError, RepositoryNotFoundError):
            card = ModelCard.load(repo_id, token=token)
        if card is None:
            return cls(report)
        license, tags = card.data.license, card.data.tags or ()
        return cls(
            report,
            None if license in (None, "unknown") else str(license),
            tuple(tag for tag in tags if tag not in TAGS),
            card.text.partition(KEPT_BELOW)[2].strip(),
        )


def _picture(policy: LearnedIKPolicy) -> Animation | None:
    """The policy's arm as it is led through a singularity; None for an arm that has none."""
    from lerobot_mimicik.evaluation.animation import animate
    from lerobot_mimicik.evaluation.side_by_side import follow

    shown = follow(policy.config.arm_description(), policy=policy)
    return None if shown is None else animate(shown)


def _given_report(report: str | Path | Mapping[str, Any] | None, digest: str) -> Mapping[str, Any] | None:
    if report is None:
        return None
    found = report if isinstance(report, Mapping) else read_report(report)
    measured = _measured_weights(found)
    if measured not in (None, digest):
        raise ValueError(
            f"the report is about other weights: it measured {measured[:12]}, these are {digest[:12]}. "
            "Run `mimicik eval` with this checkpoint"
        )
    return found


def _measured_weights(report: Mapping[str, Any]) -> str | None:
    measured = report.get("settings", {}).get("weights")
    return None if measured is None else str(measured)


def _checkpoint_folder(source: str | Path, token: str | None) -> Path:
    folder = Path(source)
    if not folder.exists():
        try:
            folder = Path(snapshot_download(str(source), allow_patterns=_CHECKPOINT_FILES, token=token))
        except (HFValidationError, RepositoryNotFoundError) as error:
            raise FileNotFoundError(
                f"source {str(source)!r} is neither a folder nor a Hub repository"
            ) from error
    if not (folder / CONFIG_NAME).is_file():
        raise FileNotFoundError(f"source {str(source)!r} is no checkpoint: it has no {CONFIG_NAME}")
    return folder


def _recorded_training(folder: Path | None, digest: str) -> TrainingFacts:
    """The training that made the checkpoint; unknown for weights that have changed since."""
    if folder is None or _digest_of(folder) != digest:
        return TrainingFacts()
    return TrainingFacts.of_checkpoint(folder)


def _digest_of(folder: Path) -> str | None:
    weights = folder / SAFETENSORS_SINGLE_FILE
    return weights_digest(load_file(weights)) if weights.is_file() else None


def _write_processors(policy: LearnedIKPolicy, folder: Path | None, out: Path) -> None:
    """Processors, and what else belongs to the checkpoint, from its folder; without one, new processors."""
    if folder is None:
        from lerobot.processor import make_default_pre_post_processors

        # Those of every kind here: each normalises by itself.
        for processor in make_default_pre_post_processors(policy.config, None):
            processor.save_pretrained(out)
        return
    for file in sorted(path for pattern in _CHECKPOINT_FILES for path in folder.glob(pattern)):
        if file.name not in (CONFIG_NAME, SAFETENSORS_SINGLE_FILE, REPORT_NAME):
            shutil.copyfile(file, out / file.name)
