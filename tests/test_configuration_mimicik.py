"""The configuration refuses what cannot work, and carries what a checkpoint needs."""

import json
from pathlib import Path

import draccus
import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig

from lerobot_mimicik.configuration_mimicik import MimicIKConfig
from lerobot_mimicik.kinematics.arms import describe_arm

JOINTS = [f"joint{i}" for i in range(1, 7)]
CONFIGS = Path(__file__).parent.parent / "configs"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"objective": "gan"}, "objective='gan': expected one of mip, flow, regression"),
        ({"conditioning": "x"}, "expected one of paper, relative"),
        ({"joint_units": "turns"}, "expected one of rad, deg"),
        ({"n_obs_steps": 0}, "n_obs_steps=0"),
        ({"d_model": 250}, "multiple of 4"),
        ({"fk_weight": -1.0}, "fk_weight=-1"),
        ({"fk_position_scale": 0.0}, "fk_position_scale=0"),
        ({"t_star": 1.0}, "t_star=1"),
        ({"tip_link": "nowhere"}, "nowhere"),
        ({"n_obs_steps": 100_000}, "n_obs_steps=100000: expected 1 to 100"),
        ({"n_layers": 10**9}, "n_layers=1000000000: expected 1 to 256"),
        ({"n_obs_steps": None}, "n_obs_steps=None: expected a whole number"),
        ({"fk_weight": float("nan")}, "fk_weight=nan: expected a number"),
        ({"clip_delta": "yes"}, "clip_delta='yes': expected true or false"),
    ],
)
def test_impossible_settings_name_themselves(options, message):
    with pytest.raises(ValueError, match=message):
        MimicIKConfig(device="cpu", **options)


def test_saved_configuration_contains_the_urdf(tmp_path):
    config = MimicIKConfig(device="cpu", tool_offset=[0.1594, 0.0, 0.0])
    config.save_pretrained(tmp_path)
    saved = json.loads((tmp_path / "config.json").read_text())
    assert "<robot" in saved["urdf"]
    again = PreTrainedConfig.from_pretrained(tmp_path)
    assert again == config
    assert again.arm_description().tool_offset == (0.1594, 0.0, 0.0)


def test_urdf_may_be_a_path(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(describe_arm("piper").urdf)
    config = MimicIKConfig(device="cpu", urdf=str(path))
    path.unlink()
    assert config.arm_description().urdf == describe_arm("piper").urdf


def test_dataset_without_joints_or_commands_is_refused():
    config = MimicIKConfig(device="cpu")
    with pytest.raises(ValueError, match=r"no 'observation.state'.*\['action'\]"):
        config.set_dataset_feature_metadata({"action": {"shape": (6,), "names": JOINTS}})
    state = {"observation.state": {"shape": (6,), "names": JOINTS}}
    with pytest.raises(ValueError, match="next_state"):
        config.set_dataset_feature_metadata(state)
    short = state | {
        "action": {"shape": (6,), "names": JOINTS},
        "observation.ee_target": {"shape": (6,), "names": None},
    }
    with pytest.raises(ValueError, match=r"observation\.ee_target has 6 elements"):
        config.set_dataset_feature_metadata(short)


def test_cameras_are_left_alone():
    features = {
        "observation.state": {"shape": (6,), "names": JOINTS},
        "observation.images.top": {"shape": (480, 640, 3), "names": None},
        "action": {"shape": (6,), "names": JOINTS},
    }
    config = MimicIKConfig(device="cpu")
    config.set_dataset_feature_metadata(features)
    assert set(config.input_features) == {"observation.state", "observation.ee_target"}


def parse(name: str, *overrides: str) -> TrainPipelineConfig:
    return draccus.parse(TrainPipelineConfig, config_path=CONFIGS / name, args=list(overrides))


def test_paper_configuration_spells_the_paper():
    config = parse("paper.json")
    policy = config.policy
    assert (config.batch_size, config.steps) == (512, 300_000)
    assert (policy.conditioning, policy.objective, policy.fk_weight) == ("paper", "mip", 0.1)
    assert (policy.d_model, policy.n_layers, policy.n_heads) == (256, 8, 4)
    optimizer, scheduler = policy.get_optimizer_preset(), policy.get_scheduler_preset()
    assert (optimizer.lr, optimizer.weight_decay, optimizer.grad_clip_norm) == (1e-4, 1e-5, 10.0)
    assert scheduler.num_warmup_steps == 0
    assert policy.ema_decay == 0.995


@pytest.mark.parametrize("name", ["paper.json", "small.json"])
def test_ablations_are_one_flag(name):
    reference = parse(name)
    for fk_weight in (0.0, 0.05, 0.2, 0.5):
        changed = parse(name, f"--policy.fk_weight={fk_weight}")
        assert changed.policy.fk_weight == fk_weight
        changed.policy.fk_weight = reference.policy.fk_weight
        assert changed == reference


@pytest.mark.parametrize(
    ("argument", "reason"),
    [
        ("--policy.joint_units=degrees", "joint_units='degrees': expected one of rad, deg"),
        ("--policy.urdf=franka", r"'franka' is neither a shipped arm \(airbot_play"),
        ("--policy.device=gpu", "Unknown device gpu"),
        ("--policy.d_model=250", "multiple of 4"),
        ("--policy.n_obs_steps=100000", "expected 1 to 100"),
    ],
)
def test_lerobot_train_tells_why_a_value_is_refused(argument, reason):
    with pytest.raises(draccus.utils.DecodingError, match=reason):  # LeRobot prints its text
        parse("small.json", argument)


def test_a_checkpoint_tells_why_its_configuration_is_refused(tmp_path):
    MimicIKConfig(device="cpu").save_pretrained(tmp_path)
    file = tmp_path / "config.json"
    file.write_text(file.read_text().replace('"relative"', '"telepathic"'))
    with pytest.raises(draccus.utils.DecodingError, match="conditioning='telepathic': expected one of"):
        PreTrainedConfig.from_pretrained(tmp_path)


def test_a_network_too_large_for_memory_is_refused_before_it_is_built():
    from lerobot_mimicik.modeling_mimicik import MimicIKPolicy

    config = MimicIKConfig(device="cpu", d_model=8192, d_ff=65_536, n_layers=4)
    with pytest.raises(ValueError, match=r"a network of [\d,]+ weights: expected at most 500,000,000"):
        MimicIKPolicy(config)


def test_an_arm_of_a_hundred_joints_is_refused():
    joint = (
        "<joint name='j{0}' type='revolute'><parent link='l{0}'/><child link='l{1}'/>"
        "<limit lower='-1' upper='1'/></joint>"
    )
    links = "".join(f"<link name='l{i}'/>" for i in range(101))
    urdf = f"<robot name='r'>{links}{''.join(joint.format(i, i + 1) for i in range(100))}</robot>"
    with pytest.raises(ValueError, match="100 joints: expected at most 32"):
        MimicIKConfig(device="cpu", urdf=urdf)


def features(names, commands=None):
    return {
        "observation.state": {"shape": (len(names),), "names": names},
        "action": {"shape": (len(commands or names),), "names": commands or names},
    }


def test_the_arm_is_the_datasets_own_unless_another_is_asked_for(tmp_path, caplog):
    piper = describe_arm("piper")
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "arm.json").write_text(piper.to_json())
    config = MimicIKConfig(device="cpu", tool_offset=[0.1, 0.0, 0.0])
    config.use_dataset(tmp_path, features(JOINTS))
    assert config.arm_description().urdf == piper.urdf
    assert config.arm_description().tip_link == piper.tip_link
    assert config.tool_offset == [0.1, 0.0, 0.0]
    asked = MimicIKConfig(device="cpu", urdf="airbot_play")
    asked.use_dataset(tmp_path, features(JOINTS))
    assert asked.arm_description().urdf == describe_arm("airbot_play").urdf
    assert "another arm than --policy.urdf" in caplog.text
    config.save_pretrained(tmp_path / "saved")
    saved = PreTrainedConfig.from_pretrained(tmp_path / "saved")
    saved.use_dataset(tmp_path, features(JOINTS))
    assert saved == config


def test_a_damaged_arm_of_a_dataset_is_named(tmp_path):
    (tmp_path / "meta").mkdir()
    for text in ("{", "[]", '{"urdf": "<robot/>", "base_link": "a", "tip_link": "b", "joint_names": []}'):
        (tmp_path / "meta" / "arm.json").write_text(text)
        with pytest.raises(ValueError, match=r"meta/arm\.json describes no arm"):
            MimicIKConfig(device="cpu").use_dataset(tmp_path, features(JOINTS))


@pytest.mark.parametrize("urdf", ["", "airbot_play"])
def test_joints_that_are_not_the_arms_are_refused(tmp_path, urdf):
    from lerobot_mimicik.modeling_mimicik import MimicIKPolicy

    other = features(["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"])
    config = MimicIKConfig(device="cpu", urdf=urdf)
    message = (
        r"elements \['shoulder_pan', .*joints are \['joint1', .*--policy.urdf=.*--policy.state_joint_names="
    )
    with pytest.raises(ValueError, match=message):
        config.use_dataset(tmp_path, other)

    def as_lerobot_asks():
        config = MimicIKConfig(device="cpu", urdf=urdf)
        config.set_dataset_feature_metadata(other)
        MimicIKPolicy(config)

    with pytest.raises(ValueError, match=message):
        as_lerobot_asks()


def test_joints_may_be_named_by_the_user_for_state_and_action_at_once(tmp_path):
    names = ["grip", *"abcdef"]
    for chosen in (list("abcdef"), ["1", "2", "3", "4", "5", "6"]):
        config = MimicIKConfig(device="cpu", state_joint_names=chosen)
        config.use_dataset(tmp_path, features(names))
        assert config.state_joint_columns == config.action_joint_columns == [1, 2, 3, 4, 5, 6]
