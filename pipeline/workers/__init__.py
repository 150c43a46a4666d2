"""Workers: in which process, and on which machine, units of work run."""
