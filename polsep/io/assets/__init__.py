"""Meshes, textures and maps of other programs."""
