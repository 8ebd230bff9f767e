"""`lerobot-train` once for each fk_update named in $FK_UPDATES, in the same processes.

After each, every process writes the weights it holds to $DUMP/<fk_update>-rank<r>.safetensors.
"""

import os
import sys

from accelerate import Accelerator
from accelerate.utils import DistributedDataParallelKwargs
from lerobot.scripts.lerobot_train import train
from lerobot.utils.import_utils import register_third_party_plugins
from safetensors.torch import save_file


class Lasting(Accelerator):
    """Keeps the group of processes after a training: the next one needs it."""

    def end_training(self) -> None:
        pass


def main() -> None:
    register_third_party_plugins()
    arguments = sys.argv[1:]
    for fk_update in os.environ["FK_UPDATES"].split():
        accelerator = Lasting(
            step_scheduler_with_optimizer=False,
            kwargs_handlers=[DistributedDataParallelKwargs(find_unused_parameters=True)],
            cpu=True,
        )
        output = os.path.join(os.environ["DUMP"], fk_update)
        sys.argv[1:] = [*arguments, f"--policy.fk_update={fk_update}", f"--output_dir={output}"]
        train(accelerator=accelerator)
        policy = accelerator.unwrap_model(accelerator._models[-1])
        weights = {name: value.contiguous() for name, value in policy.state_dict().items()}
        save_file(weights, f"{output}-rank{accelerator.process_index}.safetensors")
    accelerator.state.destroy_process_group()


if __name__ == "__main__":
    sys.exit(main())
