"""`Mine` comes from a module that nobody has."""

import nothing_of_that_name

Mine = nothing_of_that_name.Mine
