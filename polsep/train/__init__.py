"""Training: streamed examples, losses, one loop. The only subpackage with optimizers. Needs the extra ``train``."""
