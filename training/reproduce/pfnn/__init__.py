"""PF-NN: Wang, Wang, Liu, *Computers* 2026, 15(3), 172: adaptive particle filter with a neural
weight corrector. Its tables 3–5 and figures 2–9, and a study of robustness beyond it."""
