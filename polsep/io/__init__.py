"""The only room that touches files: raw frames in (`frames`, `genicam`), separations and previews out (`outputs`, `previews`)."""
