"""Materials of flat samples: random ones, photographs of them, estimates from one or several captures, files."""
