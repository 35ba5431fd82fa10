"""Training: streamed examples, losses, one loop. The only room with optimizers. Needs the extra ``train``."""
