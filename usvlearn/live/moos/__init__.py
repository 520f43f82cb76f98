"""The node as an app of MOOS: the wire, a client, mission files and the app, with the standard library alone."""
