"""Layer 3: simulated and cached episodes, their seeds, and data sets."""
