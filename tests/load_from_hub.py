"""A new user's process: loads REPO from the Hub, asks it what $ASK holds and writes the commands to $ASK.

It knows nothing of the training, and also runs the Python example of the repository's model card.
"""

import os
import re
import sys

import torch
from huggingface_hub import ModelCard
from lerobot.policies.factory import make_pre_post_processors
from safetensors.torch import load_file, save_file

from lerobot_mimicik.modeling_mimicik import MimicIKPolicy


def main() -> None:
    repo, ask = sys.argv[1], os.environ["ASK"]
    policy = MimicIKPolicy.from_pretrained(repo)
    before, after = make_pre_post_processors(policy.config, pretrained_path=repo)
    batch = load_file(ask)
    answers = {"joints": policy.predict_joints(batch["observation.state"], batch["observation.ee_target"])}
    policy.reset()
    answers["action"] = after(policy.select_action(before(dict(batch))))
    example = re.search(r"## Use\n.*?```python\n(.*?)```", ModelCard.load(repo).text, re.DOTALL)
    shown: dict[str, torch.Tensor] = {}
    exec(example.group(1), shown)
    answers["example"] = torch.from_numpy(shown["result"].q)[None]
    save_file(answers, ask)


if __name__ == "__main__":
    main()
