"""MCAP logs in ROS 2 CDR, as rosbag2 records them: read into columns, written from columns."""

from tbmfg.mcap.reader import read_log
from tbmfg.mcap.writer import write_log

__all__ = ["read_log", "write_log"]
