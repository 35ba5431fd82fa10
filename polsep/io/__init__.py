"""The only room that touches files: raw frames in (`frames`), separations and their previews out (`outputs`)."""
