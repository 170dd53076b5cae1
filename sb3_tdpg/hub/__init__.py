"""Models go to the Hugging Face Hub and come from it, as those of Stable-Baselines3 do."""

from sb3_tdpg.hub.publication import Publication
from sb3_tdpg.hub.transfer import load_from_hub, pull_from_hub, push_to_hub, write_model_card

__all__ = ["Publication", "load_from_hub", "pull_from_hub", "push_to_hub", "write_model_card"]
