"""`lerobot-train`, after which every process writes the weights it holds to $DUMP/rank<r>.safetensors."""

import os
import sys

from accelerate import Accelerator
from accelerate.utils import DistributedDataParallelKwargs
from lerobot.scripts.lerobot_train import train
from lerobot.utils.import_utils import register_third_party_plugins
from safetensors.torch import save_file


def main() -> None:
    register_third_party_plugins()
    accelerator = Accelerator(
        step_scheduler_with_optimizer=False,
        kwargs_handlers=[DistributedDataParallelKwargs(find_unused_parameters=True)],
        cpu=True,
    )
    train(accelerator=accelerator)
    policy = accelerator.unwrap_model(accelerator._models[-1])
    weights = {name: value.contiguous() for name, value in policy.state_dict().items()}
    save_file(weights, os.path.join(os.environ["DUMP"], f"rank{accelerator.process_index}.safetensors"))


if __name__ == "__main__":
    sys.exit(main())
