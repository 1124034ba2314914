"""Videos of agents and of what their search looks at."""

from sb3_mcbs.video.recording import Outcome, Performer, record_episodes, show_live
from sb3_mcbs.video.scene import RenderingError

__all__ = ["Outcome", "Performer", "RenderingError", "record_episodes", "show_live"]
