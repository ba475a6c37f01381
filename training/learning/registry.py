"""Trainings by name: what can be learned, and with which options."""

from coloc_env.registry import Registry

TRAININGS = Registry(
    "training",
    "coloc.trainings",
    {
        "dlspf": "training.learning.dlspf:dlspf",
        "ippo": "training.learning.mappo:ippo",
        "mappo": "training.learning.mappo:mappo",
        "nnhpff": "training.learning.nnhpff:nnhpff",
        "pf_corrected": "training.learning.pf_corrected:pf_corrected",
        "pfnn": "training.learning.pfnn:pfnn",
        "sb3-ppo": "training.learning.sb3_ppo:sb3_ppo",
        "task-ippo": "training.learning.tasks.ppo:task_ippo",
        "task-mappo": "training.learning.tasks.ppo:task_mappo",
        "task-qmix": "training.learning.tasks.qmix:task_qmix",
        "task-sb3-ppo": "training.learning.tasks.sb3:task_sb3_ppo",
        "stdcl": "training.learning.stdcl:stdcl",
        "stdcl_loop": "training.learning.stdcl_loop:stdcl_loop",
        "trust": "training.learning.trust:trust",
    },
)
