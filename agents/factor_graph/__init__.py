"""Factor graphs, solved by GTSAM."""
