"""What verbs do, as functions that return objects; the command line adds settings and printing."""
