"""The free rigid body (Celledoni, Marthinsen & Owren 2003, Section 3.1)."""
