"""Studio: the commands in a browser on one's own machine. One page over a folder of captures; it owns no state of its own."""
