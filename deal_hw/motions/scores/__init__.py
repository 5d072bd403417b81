"""How well a run went, from its recording alone."""
