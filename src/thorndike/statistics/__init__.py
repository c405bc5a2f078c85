"""Numbers that say how sure they are: robust means, intervals, summaries over seeds."""

from thorndike.statistics.estimates import Summary, interquartile_mean, stratified_bootstrap_interval, summary, wilson_interval

__all__ = ["Summary", "interquartile_mean", "stratified_bootstrap_interval", "summary", "wilson_interval"]
