"""An agent's networks as functions of arrays and as plain MLPs, and gradient steps with SB3's mathematics."""
