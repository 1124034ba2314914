"""``sb3-mcbs doctor``: whether look-ahead works for an environment, and what it costs."""
