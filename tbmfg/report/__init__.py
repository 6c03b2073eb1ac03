"""One self-contained HTML page about a run or a comparison: words first, then tables, then figures; works offline."""

from tbmfg.report.content import Report, stamps_of

__all__ = ["Report", "stamps_of"]
