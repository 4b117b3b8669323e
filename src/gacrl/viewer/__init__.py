"""The live page: a policy plays in this process, and browsers show it and say what happens to it."""
