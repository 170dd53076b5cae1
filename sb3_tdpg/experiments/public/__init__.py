"""TDPG beside PPO and RecurrentPPO on tasks that others made."""
