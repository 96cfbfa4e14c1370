"""Several workers in one launch on the CPU: barrier, ray schedule, sinks of gradients."""
