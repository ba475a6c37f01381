"""Import of ROS 1 bags, ROS 2 bags and MCAP files, with rosbags (extra ``ros``)."""

from coloc_env.datasets.bags.importer import import_bag
from coloc_env.datasets.bags.listing import first_topics

__all__ = ["first_topics", "import_bag"]
