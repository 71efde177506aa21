"""Layer 0: meshes, finite elements, sparse factorisation and compiled kernels."""
