"""Live acquisition: cameras and files as sources of raw frames, recorded without loss while the separation is shown."""
