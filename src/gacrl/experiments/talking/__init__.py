"""The study of talk: all tasks that need it, all kinds of communication, around one learner."""
