"""`mimicik export`: a checkpoint as one ONNX file, for computers without torch and LeRobot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from lerobot_mimicik import outputs
from lerobot_mimicik.cli.eval import PolicySource
from lerobot_mimicik.cli.options import parse, say_loading

HELP = "Write a checkpoint as one ONNX file, which ONNX Runtime answers from without torch and LeRobot."


@dataclass
class ExportConfig:
    """Options of `mimicik export`.

    Example: `mimicik export --policy.path=outputs/demo/train --output=outputs/airbot_play.onnx`
    """

    policy: PolicySource = field(default_factory=PolicySource)
    # The file; one that this command wrote is replaced.
    output: str = ""


def main(argv: Sequence[str]) -> int:
    """Parse the command line, export and print."""
    config = parse(ExportConfig, argv, "mimicik export")
    from lerobot_mimicik.checkpoints import find_checkpoint
    from lerobot_mimicik.foresight.weights import is_foresight, shipped
    from lerobot_mimicik.inference.onnx_file import PRODUCER, SUFFIX

    if not config.policy.path or not config.output:
        raise ValueError("--policy.path (a checkpoint) and --output (a file, NAME.onnx) are needed")
    if Path(config.output).suffix != SUFFIX:
        raise ValueError(f"--output={config.output}: expected a name that ends with {SUFFIX}")
    name = config.policy.path
    found = name if name in shipped() else find_checkpoint(name)
    if found in shipped() or is_foresight(found):
        raise ValueError(
            f"{name} is foresight, which is not exported: its weights run in numpy as they are, without torch and LeRobot. "
            "Take the checkpoint's folder, or the arm's name, to the other computer"
        )
    outputs.check_file(config.output, "--output", PRODUCER.encode())
    say_loading()
    from lerobot_mimicik.checkpoints import load_policy
    from lerobot_mimicik.inference.onnx_export import write

    policy = load_policy(found, "cpu").eval()
    apart = write(policy, config.output)
    size = Path(config.output).stat().st_size / 1e6
    print(f"{config.output}: {policy.config.type}, {size:.1f} MB, within {apart:.1e} rad of the policy")
    return 0
