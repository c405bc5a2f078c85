"""The studio: one app for the browser, one page a file, on this machine only."""
