"""Files for and from other programs: meshes, textures, maps and materials."""
