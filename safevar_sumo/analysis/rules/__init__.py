"""Rules in physical units that tell where settings are unsafe."""
