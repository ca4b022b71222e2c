"""Pictures of answers, plans and inputs with matplotlib (the extra ``plot``), which compute nothing."""
