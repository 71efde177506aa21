"""Layer 1: flow, transport (convection-diffusion), EIT (complete electrodes), observations."""
