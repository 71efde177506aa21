"""eitbench: process tomography as Gymnasium environments, with honest baselines and scores."""
