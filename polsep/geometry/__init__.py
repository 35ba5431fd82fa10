"""Shape from separated images: normals and albedo under some lights, and the surface that normals span.

Needs the extra ``mesh``.
"""
