"""Diffuse and specular by closed forms, and the report of a separated frame; kernels lie beside their twins."""
