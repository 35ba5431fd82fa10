"""The polarization sensor: layouts, levels, noise, orientation, packed samples."""
