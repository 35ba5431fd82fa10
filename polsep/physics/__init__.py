"""The physics of polarized light: Stokes vectors, Mueller matrices, Fresnel, microfacets."""
