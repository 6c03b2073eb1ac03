"""A rig from what a log shows, and as a file to edit."""

from tbmfg.inference.draft import Assumption, Inferred
from tbmfg.inference.infer import infer
from tbmfg.inference.starter import starter

__all__ = ["Assumption", "Inferred", "infer", "starter"]
