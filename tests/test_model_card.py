"""The model card: what it tells about robot, training and accuracy, and what it does not claim."""

import ast
import re
from types import SimpleNamespace

import pytest
from hub_contents import check_metadata

from lerobot_mimicik.configuration_mimicik import MimicIKConfig
from lerobot_mimicik.evaluation.report import ROW_KEYS
from lerobot_mimicik.modeling_mimicik import MimicIKPolicy
from lerobot_mimicik.publishing.model_card import model_card
from lerobot_mimicik.publishing.training_facts import TrainingFacts

SMALL = {"d_model": 16, "n_layers": 1, "n_heads": 2, "d_ff": 16, "device": "cpu"}
RAIL = """<robot name="rail"><link name="a"/><link name="b"/><link name="c"/>
<joint name="slide" type="prismatic"><parent link="a"/><child link="b"/><axis xyz="1 0 0"/>
<limit lower="0" upper="0.75" velocity="1" effort="1"/></joint>
<joint name="spin" type="continuous"><parent link="b"/><child link="c"/><axis xyz="0 0 1"/></joint></robot>"""


@pytest.fixture(scope="module")
def policy() -> MimicIKPolicy:
    return MimicIKPolicy(MimicIKConfig(urdf="piper", joint_units="deg", **SMALL))


def report() -> dict:
    row = dict.fromkeys(ROW_KEYS, 0.0) | {
        "solver": "mimicik", "mode": "closed_loop", "dataset": "test", "frames": 100, "nonfinite": 0,
        "mean_mm": 1.234, "jerk": None, "verdict": "Bounded", "reason": "4 singular passages",
    }  # fmt: skip
    return {"rows": [row], "datasets": [{"name": "test", "episodes": 2, "frames": 100, "fps": 15}]}


def test_shows_the_robot(policy):
    text = model_card(policy).text
    for joint in policy.config.arm_description().joints():
        assert f"| `{joint.name}` | revolute | {joint.lower:.3f} rad" in text
    assert policy.config.base_link in text
    assert policy.config.tip_link in text
    assert "| joints in datasets and commands | deg |" in text
    assert "none: the tip link's frame" in text


def test_shows_joints_without_limits_and_those_that_slide():
    rail = MimicIKPolicy(MimicIKConfig(urdf=RAIL, tool_offset=[0, 0, 0.1, 0, 1.5, 0], **SMALL))
    text = model_card(rail).text
    assert "# MimicIK for rail" in text
    assert "| `slide` | prismatic | 0.000 m | 0.750 m | 1.0000 m |" in text
    assert "| `spin` | continuous | none | none | 1.0000 rad |" in text
    assert "xyz = 0 0 0.1 m, rpy = 0 1.5 0 rad" in text


def test_shows_the_accuracy_it_is_given(policy):
    text = model_card(policy, report=report()).text
    assert "| mimicik | 1.234 |" in text
    assert "Bounded, 4 singular passages" in text
    assert "test: 2 episodes, 100 frames at 15 fps" in text
    assert "at 15 Hz" in text
    assert "No evaluation" not in text


@pytest.mark.parametrize("dataset", [None, "local/recorded", "user/recorded"])
@pytest.mark.parametrize("license", [None, "apache-2.0"])
def test_metadata_pass_the_hubs_check_and_link_only_to_the_hub(policy, dataset, license):
    card = model_card(
        policy, training=TrainingFacts(dataset=dataset), license=license, tags=["mine", "mimicik"]
    )
    assert check_metadata(str(card)) == ([], [])
    assert card.data.tags == ["inverse-kinematics", "lerobot", "mimicik", "mine", "robotics"]
    assert card.data.datasets == (["user/recorded"] if dataset == "user/recorded" else None)
    assert card.data.license == (license or "unknown")
    assert ("Nobody has stated a licence" in card.text) is (license is None)


def test_tables_and_examples_are_well_formed(policy):
    text = model_card(policy, "user/arm", TrainingFacts("a/b", 3, 4000, 20.0, 512, 0), report()).text
    assert "None" not in text
    assert text.index("MimicIKAdapter") < text.index("mimicik eval") < text.index("## Accuracy")
    tables = re.findall(r"(?:^\|.*\|\n)+", text, re.MULTILINE)
    assert len(tables) == 4
    for table in tables:
        assert len({line.count("|") for line in table.splitlines()}) == 1
    for example in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        ast.parse(example)
        assert "user/arm" in example


def test_foresight_has_a_card_of_its_own():
    from lerobot_mimicik.configuration_foresight import ForesightConfig
    from lerobot_mimicik.modeling_foresight import ForesightPolicy

    policy = ForesightPolicy(ForesightConfig(urdf="piper", hidden_dim=8, n_layers=1, device="cpu"))
    card = model_card(policy, "user/steady", picture="A hand trembles.")
    assert check_metadata(str(card)) == ([], [])
    assert "# MimicIK foresight for piper" in card.text
    assert "| tremor in training | 0 to 2.2 mm" in card.text
    assert "singularity.gif)\n\nA hand trembles." in card.text
    (example,) = re.findall(r"```python\n(.*?)```", card.text.partition("## Accuracy")[0], re.DOTALL)
    assert 'MimicIKAdapter.from_pretrained("user/steady")' in example


@pytest.mark.parametrize(
    ("file", "told"),
    [
        ("meta/retarget_report.json", "computed by retargeting"),
        ("meta/joint_log.json", "recorded on a real arm"),
        (None, "no robot was involved"),
    ],
)
def test_the_card_says_what_the_data_was(policy, tmp_path, file, told):
    (tmp_path / "meta").mkdir()
    for name in ("meta/arm.json", *filter(None, [file])):
        (tmp_path / name).write_text("{}")
    meta = SimpleNamespace(root=tmp_path, repo_id="local/x", total_episodes=3, total_frames=4000, fps=20)
    facts = TrainingFacts.of_dataset(meta)
    facts.save(tmp_path)
    assert TrainingFacts.of_checkpoint(tmp_path) == facts
    text = model_card(policy, training=facts).text
    assert told in text
    assert "3 episodes, 4,000 frames at 20 a second" in text
