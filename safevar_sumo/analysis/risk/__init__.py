"""How likely an unsafe outcome is when vehicles vary as a study says, and which characteristic decides."""
