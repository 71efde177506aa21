"""Reinforcement learning of injection policies (extra ``rl``), and policies of trained agents."""

from eitbench.rl.agents import AgentPolicy, save_agent

__all__ = ["AgentPolicy", "save_agent"]
