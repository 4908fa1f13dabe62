"""How far each characteristic may go: alone, in pairs, and all together."""
