# %% [markdown]
# # A real recording
#
# Five ground robots for twelve minutes (UTIAS MRCLAM). The data belong to their owners; put them
# into a folder and name it in `COLOC_DATA` ([where they come from](../how-to/recordings.md)).
# Where they are not found, this page shows the code alone.

# %%
import torch

from coloc_env.datasets import sequences

torch.set_num_threads(1)
try:
    found = sequences("mrclam")
except ValueError as error:
    found = []
    print(error)
print(f"{len(found)} sequence(s) of MRCLAM here")

# %% [markdown]
# A recording is a scenario: the same world, interfaces and localizers. `span` cuts it, in seconds.

# %%
from coloc_env import make_scenario
from training.evaluation.evaluate import evaluate

if found:
    scenario = make_scenario("replay-mrclam-v0", span=(0.0, 60.0))
    result = evaluate(
        scenario,
        ["dead_reckoning", "ekf", "ekf:robust=huber", "ekf:robust=huber:cooperate=false"],
        runs=1,
        bound=False,
    )
    for name, figures in result.summary["agents"].items():
        print(f"{name:35s} RMSE {figures['rmse']:.3f} m   NEES {figures['nees']:.1f}")

# %% [markdown]
# Measurements that no sensor can have made (negative, not finite) are left out when a recording is
# loaded, and counted. Steps without ground truth are not scored.
