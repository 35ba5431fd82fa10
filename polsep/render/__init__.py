"""Scenes with exact diffuse and specular light, and what a polarization camera records of them."""
