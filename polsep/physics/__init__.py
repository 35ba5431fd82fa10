"""What light does: Stokes vectors, Mueller matrices, Fresnel, microfacets."""
