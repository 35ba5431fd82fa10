"""Evidence in a frame about its light: colour, polarization, and how sure each is; it abstains where nothing shows."""
