"""The paper's numbers, as printed: tables 3 to 5, and what its text says of its figures."""

from typing import NamedTuple

TITLE = (
    "Wang, Wang, Liu: Adaptive Particle Filter-Neural Network Fusion for Cooperative Localization "
    "of Multi-UAV Systems in GNSS-Denied Indoor Environments. Computers 2026, 15(3), 172"
)
RUNS = 20  # of table 4; figure 9 has half as many more


class Spread(NamedTuple):
    """Mean and standard deviation over runs (of times: over steps)."""

    mean: float
    std: float | None = None


class Accuracy(NamedTuple):
    """A row of table 4: errors in m, and the average number of particles."""

    rmse: Spread
    mean: Spread
    max: Spread
    particles: Spread | None


class Expense(NamedTuple):
    """A row of table 5: ms per step, s in all, MB."""

    ms: Spread
    total: float
    memory: float


class Error(NamedTuple):
    """A row of table 3, in m."""

    rmse: float
    mean: float
    max: float


METHODS = {  # the paper's names of methods, by our agents'
    "pf500": "Standard PF (N = 500)",
    "pf800": "Fixed PF (N = 800)",
    "apf": "Adaptive PF (no NN)",
    "ekf": "EKF Cooperative",
    "dfgo": "DFGO",
    "dlspf": "D-LSPF",
    "pfnn": "Proposed PF-NN",
}

TABLE_3 = {
    "UAV-1": Error(0.431, 0.343, 2.737),
    "UAV-2": Error(0.374, 0.190, 5.049),
    "UAV-3": Error(0.510, 0.152, 9.783),
    "UAV-4": Error(0.535, 0.159, 10.385),
    "UAV-5": Error(0.375, 0.148, 6.039),
    "UAV-6": Error(0.402, 0.143, 7.432),
    "Average": Error(0.437, 0.189, 6.906),
}

TABLE_4 = {
    "pf500": Accuracy(Spread(0.612, 0.089), Spread(0.287, 0.052), Spread(12.45, 2.31), Spread(500)),
    "pf800": Accuracy(Spread(0.523, 0.074), Spread(0.245, 0.041), Spread(10.82, 1.95), Spread(800)),
    "apf": Accuracy(
        Spread(0.481, 0.062), Spread(0.218, 0.038), Spread(8.93, 1.47), Spread(650, 120)
    ),
    "ekf": Accuracy(Spread(0.687, 0.102), Spread(0.312, 0.058), Spread(14.23, 3.12), None),
    "dfgo": Accuracy(Spread(0.398, 0.041), Spread(0.176, 0.028), Spread(5.84, 0.89), None),
    "dlspf": Accuracy(Spread(0.456, 0.053), Spread(0.198, 0.034), Spread(7.42, 1.23), Spread(500)),
    "pfnn": Accuracy(
        Spread(0.437, 0.048), Spread(0.189, 0.031), Spread(6.91, 1.12), Spread(720, 95)
    ),
}

TABLE_5 = {
    "pf500": Expense(Spread(45.2, 3.1), 45.2, 128),
    "pf800": Expense(Spread(72.8, 4.5), 72.8, 205),
    "apf": Expense(Spread(58.6, 8.3), 58.6, 165),
    "ekf": Expense(Spread(18.5, 2.3), 18.5, 65),
    "dfgo": Expense(Spread(125.6, 15.8), 125.6, 385),
    "dlspf": Expense(Spread(89.3, 8.7), 89.3, 268),
    "pfnn": Expense(Spread(63.4, 6.7), 63.4, 178),
}

# Figure 2: ranges of the correction that were compared; numbers are of the proposed one only.
RANGES = ((0.2, 1.0), (0.3, 1.0), (0.4, 1.0), (0.5, 1.0), (0.4, 1.2), (0.4, 0.9))
PROPOSED = (0.4, 1.0)

GAINS = {  # RMSE of PF-NN below that of others, %
    "pf500": 28.6,
    "apf": 9.1,
    "ekf": 36.4,
    "dlspf": 4.2,
}
MAX_GAIN_PF500 = 44.5  # %
MAX_PARTICLES = 800
ESS_BAND = (0.3, 0.6)
RESAMPLED_EVERY = (10, 30)  # steps
START_ERROR, CONVERGED_ERROR = 2.0, 1.0  # m
SPIKES = 2.0  # m
MEDIAN = 0.2  # m
SUB_METRE = 1.0  # m
REAL_TIME = 100.0  # ms
MEMORY_SAVING_PF800 = 40.2  # %; its own 178 and 205 MB make 13.2
LOSS_START, LOSS_END, LOSS_ITERATIONS = 0.15, 0.05, 50
