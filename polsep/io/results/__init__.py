"""Writers and readers of what polsep makes: separations, films, edits, materials, shapes, rendered sets."""
