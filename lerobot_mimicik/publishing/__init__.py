"""Publishing a checkpoint: the Hub and the model card."""
