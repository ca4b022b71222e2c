// Whether the card and the tab in front are clear, and have ended to become so.
() => !document.querySelector(":is(#card, [role=tabpanel]:not([hidden])) .dim") && document.getAnimations().length === 0
