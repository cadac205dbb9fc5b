"""Episodes to watch: files for the Rerun viewer, the viewer in a browser, and videos."""
