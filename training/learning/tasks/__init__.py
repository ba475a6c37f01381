"""Learning on tasks: decisions in their worlds, rewards to train on, one file per algorithm."""
