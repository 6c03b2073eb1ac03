"""MCAP logs in ROS 2 CDR, as rosbag2 records them: read into columns, written from columns."""

from tbmfg.mcap.info import describe, info_text
from tbmfg.mcap.into import write_into
from tbmfg.mcap.reader import read_attachments, read_log
from tbmfg.mcap.trajectory import write_trajectory
from tbmfg.mcap.writer import write_log

__all__ = [
    "describe",
    "info_text",
    "read_attachments",
    "read_log",
    "write_into",
    "write_log",
    "write_trajectory",
]
