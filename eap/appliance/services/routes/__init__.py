"""Routes for those who look at them and change them: tools, scans, the control protocol."""
