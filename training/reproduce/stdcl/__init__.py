"""ST-DCL: spatio-temporally decoupled cooperative localization of a swarm (*Drones* 2026, 10(1),
69). Its figures 4–11 and 14 and tables 1 and 2, stress beyond them, what the learned part adds, and
real flights."""
