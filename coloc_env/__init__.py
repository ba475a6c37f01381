"""coloc: cooperative localization of UAV swarms as PettingZoo and TorchRL environments."""
