"""3D Gaussian splats: what cameras see of a street, trained on its photos."""
