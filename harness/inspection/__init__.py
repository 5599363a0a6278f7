"""The work of `tofpod detect`: it turns captures and arguments into findings, which it prints and
writes."""
