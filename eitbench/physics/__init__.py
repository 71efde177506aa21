"""Floor 1: meshes, flow, transport (convection-diffusion), EIT (complete electrode model) and what
is observed."""
