// All that the page says, in English and German. What the loop says comes as English words and is looked up here too.
export const LANGUAGES = ["en", "de"];

const DE = {
  connected: "Verbunden", lost: "KEINE VERBINDUNG", dead: "Steuerrechner still", title: "Bedienseite",
  "listens only": "Hört nur zu", SILENT: "Sendet nicht", LATCHED: "VERRIEGELT", READY: "Bereit", ACTIVE: "STEUERT VENTILE",
  "dead-man held": "Totmann gehalten", "dead-man released": "Totmann los", "recording": "Aufnahme", "not recording": "Keine Aufnahme", gaps: "Lücken",
  start: "Führung ein", stop: "STOPP", record: "Aufnahme", boreholes: "Bohrloch wählen", camera: "Kamera", positions: "Stellung", levers: "Hebel",
  advice: "Vorschlag", borehole: "Bohrloch", never: "fehlt", advised: "Vorschlag", own: "Eigener Hebel", left: "Linker Hebel", right: "Rechter Hebel",
  "button off": "Taste loslassen", "button due": "Taste in", "button now": "Taste HALTEN", guiding: "Hebel auf Grün führen", stopped: "Führung aus",
  "start auto": "Scharf", "guiding auto": "Die Maschine fährt selbst: Hände von den Hebeln", "stopped auto": "Es wird nichts gesendet", unknown: "Unbekannt",
  "no 3D": "Kein 3D: dieser Browser bietet kein WebGL 2", unsure: "unbekannt", "no borehole": "Kein Bohrloch bekannt", scene: "3D-Ansicht: ziehen dreht",
  "refused token": "Kein Zugriff: Seite über den Link mit Schlüssel öffnen", "refused deadman": "Abgelehnt: Totmann halten",
  "refused target": "Abgelehnt: dieses Bohrloch gibt es nicht mehr", "refused busy": "Abgelehnt: die Steuerung nimmt es nicht an",
  "refused nowhere": "Abgelehnt: dort ist keine Fläche gemessen", "boreholes seen": "Loch wählen, antippen", "no borehole seen": "Bohrloch antippen", "refused malformed": "Abgelehnt: nicht verstanden", "refused lost": "Keine Verbindung zur Steuerung",
  "refused unconfirmed": "STOPP NICHT BESTÄTIGT: Not-Halt drücken", "recording failed": "AUFNAHME ABGEBROCHEN",
  replay: "Aufzeichnung", play: "Abspielen", pause: "Anhalten", speed: "Geschwindigkeit", "position in the recording": "Stelle der Aufzeichnung",
  "refused replay": "Dies ist eine Aufzeichnung: hier ist nichts zu steuern", "refused live": "Abgelehnt: dies ist keine Aufzeichnung", target: "Bohrloch gewählt", point: "Bohrloch angetippt",
  depth: "Tiefe", lateral: "Seitlich", angle: "Winkel", inserted: "EINGEFÜHRT", "in the hole": "Im Loch", "over the hole": "Über dem Loch", "beside the hole": "Neben dem Loch",
  "along the tool": "Am Werkzeug entlang", sound: "Töne", night: "Nacht",
  slew: "Schwenken", arm_1: "Arm 1", arm_2: "Arm 2", arm_3: "Arm 3", boom: "Ausleger", stick: "Stiel", bucket: "Löffel", tool: "Werkzeug",
  "control computer silent": "Steuerrechner still", "supervisor silent": "Überwacher still: Aufnahme und Start gehen nicht", "nothing has come": "Noch nichts gekommen", "too old": "Veraltet",
  "messages arrive late": "Nachrichten kommen spät", "recorder does not write": "Aufnahme schreibt nicht", "recording has gaps": "Aufnahme hat Lücken",
  nothing: "alles in Ordnung", "bus down": "Bus gestört", "time stood still": "Zeit stand still", "emergency stop": "NOT-HALT",
  "machine status missing": "Maschinenzustand fehlt", "remote missing": "Fernbedienung fehlt", "joint positions missing": "Gelenkstellungen fehlen", "valve feedback missing": "Ventilrückmeldung fehlt",
  "joint positions not plausible": "Gelenkstellungen unglaubwürdig", "messages corrupted or from two senders": "Nachrichten verfälscht oder von zwei Sendern",
  "operator's switches missing": "Überwacher der Steuerung still", "operator's page silent": "Bedienseite still",
  "operator did not answer": "Bediener antwortet nicht", "gateway has another bus description or machine": "Steuergerät hat andere Busbeschreibung oder Maschine",
  "a joint is driven unasked, or in place of another": "wird ungefragt oder statt eines anderen angesteuert", "a joint is driven the wrong way": "wird verkehrt herum angesteuert",
  "a joint is driven more or less than asked": "wird mehr oder weniger als verlangt angesteuert", "valves switched too often": "Ventile schalten zu oft",
  "borehole is no number": "Bohrloch ist keine Zahl", "borehole found too long ago": "Bohrloch zu lange nicht gesehen", "borehole out of reach": "Bohrloch außer Reichweite",
  "borehole below the ground": "Bohrloch unter dem Boden", "borehole off the seen face": "Bohrloch nicht auf der gesehenen Fläche", "borehole has just jumped": "Bohrloch ist eben gesprungen",
  "the borehole is beyond its limits": "Bohrloch außerhalb der Grenzen", "the policy was not trained for such a borehole": "Für dieses Bohrloch wurde nicht trainiert", "a sensor or valve is faulty": "Sensor oder Ventil gestört", "are you there": "Noch da? Seite berühren oder Totmann lösen und drücken", "way to the gateway and back unknown or too long": "Weg zum Steuergerät unbekannt oder zu lang",
  "somebody else sends commands": "Ein anderer sendet Befehle", "operator moves a lever": "Bediener bewegt Hebel", "no fresh command": "Kein frischer Befehl",
  "command is no number, or beyond full": "Befehl ungültig", "exclusive joint together with others": "Gelenk darf nur allein fahren", "not armed": "nicht scharf", "the gateway does not follow": "Steuergerät folgt nicht",
  "a joint stands still: sensor, valve or hose": "steht still: Sensor, Ventil oder Schlauch",
  "a joint moves the wrong way: sensor or valve turned": "fährt falsch herum: Sensor oder Ventil vertauscht",
  "a joint moves too little: valve, hose or sensor": "fährt zu wenig: Ventil, Schlauch oder Sensor",
  "a joint moves unasked: sensor drifts, or valve leaks": "fährt von selbst: Sensor driftet oder Ventil leckt",
  "arm too near to ground, machine or a stay-out box": "Arm zu nah an Boden, Maschine oder Sperrbereich",
  "nothing from the bus": "Nichts vom Bus", "positions are stale": "Gelenkstellungen veraltet", "positions are not plausible": "Gelenkstellungen unglaubwürdig",
  "history is filling": "Sammelt Messwerte", "no borehole is known": "Kein Bohrloch bekannt",
  "the borehole was found too long ago": "Bohrloch zu lange nicht gesehen", "the policy's answer makes no sense": "Vorschlag unbrauchbar", "the chisel is in the borehole": "Der Meißel ist im Bohrloch",
  "no live picture": "KEIN LIVEBILD", "no picture": "kein Bild", "packets lost": "verloren", "watched elsewhere": "andere sehen zu",
  "camera moves": "Kamera fährt", "camera stays": "Kamera bleibt", "hole in sight for": "Loch sichtbar {seen} von {of} s", "no view of the hole": "Loch verdeckt", "instead of": "statt",
};
const EN = {
  connected: "Connected", lost: "NO CONNECTION", dead: "Control computer silent", title: "operator's page",
  "listens only": "Listens only", SILENT: "Sends nothing", LATCHED: "LATCHED", READY: "Ready", ACTIVE: "COMMANDS VALVES",
  "dead-man held": "Dead-man held", "dead-man released": "Dead-man released", "recording": "Recording", "not recording": "Not recording", gaps: "gaps",
  start: "Guide me", stop: "STOP", record: "Record", boreholes: "Choose the borehole", camera: "Camera", positions: "Positions", levers: "Levers",
  advice: "Advice", borehole: "Borehole", never: "missing", advised: "Advice", own: "Your lever", left: "Left lever", right: "Right lever",
  "button off": "Release button", "button due": "Button in", "button now": "HOLD button", guiding: "Bring your levers to green", stopped: "Guidance is off",
  "start auto": "Arm", "guiding auto": "The machine moves by itself: hands off the levers", "stopped auto": "Nothing is sent", unknown: "Unknown",
  "no 3D": "No 3D: this browser offers no WebGL 2", unsure: "unknown", "no borehole": "No borehole is known", scene: "3D view: drag to turn",
  "refused token": "No access: open the page by the link with the key", "refused deadman": "Refused: hold the dead-man",
  "refused target": "Refused: that borehole is gone", "refused busy": "Refused: the loop does not take it", "refused malformed": "Refused: not understood",
  "refused nowhere": "Refused: no face is measured there", "boreholes seen": "Choose or touch a borehole", "no borehole seen": "Touch the borehole",
  "refused unconfirmed": "STOP NOT CONFIRMED: press the emergency stop", "recording failed": "RECORDING HAS FAILED",
  replay: "Replay", play: "Play", pause: "Pause", speed: "Speed", "position in the recording": "Position in the recording",
  "refused replay": "This is a recording: there is nothing to control", "refused live": "Refused: this is no recording", target: "Borehole chosen", point: "Borehole touched",
  depth: "Depth", lateral: "Lateral", angle: "Angle", inserted: "INSERTED", "in the hole": "In the hole", "over the hole": "Over the hole", "beside the hole": "Beside the hole",
  "along the tool": "Along the tool", sound: "Tones", night: "Night",
  slew: "Slew", arm_1: "Arm 1", arm_2: "Arm 2", arm_3: "Arm 3", boom: "Boom", stick: "Stick", bucket: "Bucket", tool: "Tool",
  "control computer silent": "Control computer silent", "supervisor silent": "Supervisor silent: no recording, no start", "nothing has come": "Nothing has come", "too old": "Too old",
  "messages arrive late": "Messages arrive late", "recorder does not write": "Recorder does not write", "recording has gaps": "Recording has gaps",
  "refused lost": "No connection to the loop", nothing: "all is well", "emergency stop": "EMERGENCY STOP",
  "are you there": "Still there? Touch the page, or release and press the dead-man",
  "no live picture": "NO LIVE PICTURE", "no picture": "no picture", "packets lost": "lost", "watched elsewhere": "others are watching",
  "camera moves": "Camera moves", "camera stays": "Camera stays", "hole in sight for": "Hole in sight {seen} of {of} s", "no view of the hole": "Hole hidden", "instead of": "instead of",
};

export function words(language) {
  const known = language === "de" ? DE : EN;
  return key => known[key] ?? key;
}

export function preferred(setup) {
  const asked = new URLSearchParams(location.search).get("lang") ?? sessionStorage.getItem("language");
  const wanted = asked ?? (setup === "auto" ? navigator.language.slice(0, 2) : setup);
  return LANGUAGES.includes(wanted) ? wanted : "en";
}
