"""Writers and readers of polsep's own images: separations, films, edits, rendered sets, and previews of them."""
