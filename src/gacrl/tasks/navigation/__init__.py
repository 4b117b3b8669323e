"""Tasks in which agents must reach places that only others know: they are solved by talking, and not in silence."""
