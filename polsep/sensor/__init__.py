"""What the sensor does: layouts, levels, noise, orientation, packed samples."""
