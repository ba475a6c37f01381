"""The faces of World: PettingZoo, TorchRL, stable-baselines3, Gymnasium, and what they share."""
