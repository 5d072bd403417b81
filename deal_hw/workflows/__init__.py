"""The work of the verbs, as functions that return objects; the command line adds settings and printing."""
