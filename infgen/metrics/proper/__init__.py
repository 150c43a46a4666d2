"""Protocol ``proper``: scores that are best, in expectation, for the logs' distribution."""
