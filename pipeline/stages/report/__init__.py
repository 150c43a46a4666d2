"""Stage ``report``: tables, figures and one page."""
