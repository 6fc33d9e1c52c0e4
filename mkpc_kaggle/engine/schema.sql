-- The journal of a work directory: what was computed, and from what.
--
-- points, estimate and scene are derived tables. A row records the revisions of its inputs and a digest of its settings.
-- It is current if a computation today would use the same inputs and settings. The views below are that rule, and the only
-- place that has it. Rows that nobody asks for stay: another recipe or test set may ask for them.
-- A run digests the images that have points before it matches (Engine._digests): points of other contents are not current.
-- A text named inputs lists revisions, separated by blanks. F is nine float64 numbers, row by row.

-- What the latest run asked for.

CREATE TABLE about (value TEXT NOT NULL) STRICT;  -- JSON, for reports

CREATE TABLE wanted_unit (
    number INTEGER PRIMARY KEY,  -- its place in the recipe
    unit TEXT NOT NULL UNIQUE,
    stage INTEGER NOT NULL CHECK (stage IN (1, 2)),
    settings TEXT NOT NULL
) STRICT;

CREATE TABLE wanted_pair (
    position INTEGER PRIMARY KEY,
    id TEXT NOT NULL,
    batch TEXT NOT NULL,
    pair INTEGER NOT NULL REFERENCES pair,
    settings TEXT NOT NULL,  -- of its estimate
    has_row INTEGER NOT NULL CHECK (has_row IN (0, 1)),  -- 0: an extra pair, for the scene of its batch alone
    failure TEXT NOT NULL DEFAULT ''  -- why it has no points
) STRICT;
CREATE INDEX wanted_by_batch ON wanted_pair (batch, position);
CREATE INDEX wanted_by_pair ON wanted_pair (pair);

CREATE TABLE wanted_batch (batch TEXT PRIMARY KEY, settings TEXT NOT NULL) STRICT;

-- Images and pairs. Names are relative to the test side, the folder or the root of a list.

CREATE TABLE image (
    name TEXT PRIMARY KEY,
    digest TEXT NOT NULL,  -- of the file's content when it was last looked at
    width INTEGER NOT NULL CHECK (width > 0),
    height INTEGER NOT NULL CHECK (height > 0),
    focal REAL NOT NULL CHECK (focal >= 0)  -- in pixels, by EXIF; 0: unknown
) STRICT;

CREATE TABLE pair (
    id INTEGER PRIMARY KEY,
    image0 TEXT NOT NULL,
    image1 TEXT NOT NULL,
    turns0 INTEGER NOT NULL CHECK (turns0 BETWEEN 0 AND 3),
    turns1 INTEGER NOT NULL CHECK (turns1 BETWEEN 0 AND 3),
    UNIQUE (image0, image1, turns0, turns1)
) STRICT;

-- Derived tables.

CREATE TABLE points (  -- of a unit on a pair, from the contents of two images
    revision INTEGER PRIMARY KEY AUTOINCREMENT,
    pair INTEGER NOT NULL REFERENCES pair,
    settings TEXT NOT NULL,
    digest0 TEXT NOT NULL,
    digest1 TEXT NOT NULL,
    matches INTEGER NOT NULL CHECK (matches >= 0),
    keypoints INTEGER NOT NULL DEFAULT 0 CHECK (keypoints >= 0),  -- detected in the first view
    decode_seconds REAL NOT NULL,
    cluster_seconds REAL NOT NULL,
    encode_seconds REAL NOT NULL,
    match_seconds REAL NOT NULL,
    failure TEXT NOT NULL,
    note TEXT NOT NULL,
    points BLOB NOT NULL CHECK (length(points) = 20 * matches),  -- x0, y0, x1, y1, score: float32, match by match
    UNIQUE (pair, settings)
) STRICT;

CREATE TABLE region (  -- the critical regions that a unit of stage 2 looked at
    points INTEGER NOT NULL REFERENCES points ON DELETE CASCADE,
    image INTEGER NOT NULL CHECK (image IN (0, 1)),
    "left" INTEGER NOT NULL,
    top INTEGER NOT NULL,
    "right" INTEGER NOT NULL,
    bottom INTEGER NOT NULL,
    reason TEXT NOT NULL,
    clusters INTEGER NOT NULL,
    kept INTEGER NOT NULL,
    PRIMARY KEY (points, image),
    CHECK ("left" < "right" AND top < bottom)
) STRICT;

CREATE TABLE estimate (  -- of a pair, from its points
    revision INTEGER PRIMARY KEY AUTOINCREMENT,
    pair INTEGER NOT NULL REFERENCES pair,
    settings TEXT NOT NULL,
    inputs TEXT NOT NULL,
    inliers TEXT NOT NULL CHECK (json_valid(inliers)),  -- JSON: their number by the revision of the input
    F BLOB NOT NULL CHECK (length(F) = 72),
    magsac BLOB CHECK (length(magsac) = 72),
    failure TEXT NOT NULL,
    support REAL NOT NULL,
    candidates INTEGER NOT NULL,
    cost REAL NOT NULL,
    magsac_cost REAL NOT NULL,
    focals TEXT NOT NULL,  -- two numbers, in pixels
    rotation TEXT NOT NULL,  -- of an E by its inliers: the axis times radians, three numbers
    seconds REAL NOT NULL,
    UNIQUE (pair, settings, inputs)
) STRICT;

CREATE TABLE scene (  -- of a batch, from its points and estimates
    revision INTEGER PRIMARY KEY AUTOINCREMENT,
    batch TEXT NOT NULL,
    settings TEXT NOT NULL,
    inputs TEXT NOT NULL,
    images INTEGER NOT NULL CHECK (images >= 0),
    registered INTEGER NOT NULL CHECK (registered >= 0),
    points INTEGER NOT NULL CHECK (points >= 0),
    seconds REAL NOT NULL,
    failure TEXT NOT NULL,
    UNIQUE (batch, settings, inputs)
) STRICT;

CREATE TABLE model (  -- of a scene, the largest first
    scene INTEGER NOT NULL REFERENCES scene ON DELETE CASCADE,
    number INTEGER NOT NULL CHECK (number >= 0),
    reprojection_error REAL NOT NULL,  -- pixels
    points BLOB NOT NULL CHECK (length(points) % 24 = 0),  -- some of them, to draw: three float64 numbers each
    PRIMARY KEY (scene, number)
) STRICT;

CREATE TABLE camera (  -- float64 numbers: K and R row by row, t
    scene INTEGER NOT NULL REFERENCES scene ON DELETE CASCADE,
    model INTEGER NOT NULL,
    name TEXT NOT NULL,
    digest TEXT NOT NULL,
    width INTEGER NOT NULL CHECK (width > 0),
    height INTEGER NOT NULL CHECK (height > 0),
    K BLOB NOT NULL CHECK (length(K) = 72),
    R BLOB NOT NULL CHECK (length(R) = 72),
    t BLOB NOT NULL CHECK (length(t) = 24),
    points INTEGER NOT NULL CHECK (points >= 0),  -- that the image sees
    rotation REAL,  -- degrees; NULL where the expected errors are unknown
    centre REAL,  -- a share of the model's size
    focal REAL,  -- percent
    FOREIGN KEY (scene, model) REFERENCES model
) STRICT;
CREATE INDEX camera_of_model ON camera (scene, model);

CREATE TABLE choice (  -- F of a pair by its scene; NULL: the pair keeps its own
    scene INTEGER NOT NULL REFERENCES scene ON DELETE CASCADE,
    pair INTEGER NOT NULL REFERENCES pair,
    inputs TEXT NOT NULL,  -- of the pair
    reason TEXT NOT NULL,
    F BLOB CHECK (length(F) = 72),
    PRIMARY KEY (scene, pair)
) STRICT;

CREATE TABLE feature (  -- of an image, or of the images of a dataset, by the digest of the contents
    digest TEXT NOT NULL,
    settings TEXT NOT NULL,
    value BLOB NOT NULL,
    PRIMARY KEY (digest, settings)
) STRICT;

CREATE TABLE event (
    number INTEGER PRIMARY KEY,
    kind TEXT NOT NULL CHECK (kind IN ('start', 'plan', 'scene', 'fault', 'end')),
    seconds REAL NOT NULL,
    text TEXT NOT NULL
) STRICT;

-- The rule.

CREATE VIEW current_points AS
SELECT w.position, w.batch, u.number, u.unit, u.stage, p.*
FROM wanted_pair w
JOIN pair ON pair.id = w.pair
JOIN image i0 ON i0.name = pair.image0
JOIN image i1 ON i1.name = pair.image1
JOIN points p ON p.pair = w.pair AND p.digest0 = i0.digest AND p.digest1 = i1.digest
JOIN wanted_unit u ON u.settings = p.settings;

CREATE VIEW pair_inputs AS  -- NULL: the pair has no points
SELECT w.position, w.pair, w.batch, w.settings, (
    SELECT group_concat(revision, ' ')
    FROM (SELECT c.revision FROM current_points c WHERE c.position = w.position ORDER BY c.number)
) AS inputs
FROM wanted_pair w;

CREATE VIEW batch_inputs AS
SELECT b.batch, b.settings, (
    SELECT group_concat(part, ' ')
    FROM (
        SELECT i.inputs || ':' || coalesce(e.revision, '') AS part
        FROM pair_inputs i
        LEFT JOIN estimate e ON e.pair = i.pair AND e.settings = i.settings AND e.inputs = i.inputs
        WHERE i.batch = b.batch AND i.inputs IS NOT NULL
        ORDER BY i.position
    )
) AS inputs
FROM wanted_batch b;

-- Until a current row exists, the latest row stands in for it, while the first points that it was computed from are current.
-- A cast takes the first number of a list.

CREATE VIEW pair_standing AS  -- the revision of its estimate, NULL: none
SELECT i.position, i.settings, i.inputs, coalesce(
    (SELECT c.revision FROM estimate c WHERE c.pair = i.pair AND c.settings = i.settings AND c.inputs = i.inputs),
    (
        SELECT max(l.revision) FROM estimate l
        JOIN current_points p ON p.position = i.position AND p.revision = CAST(l.inputs AS INTEGER)
        WHERE l.pair = i.pair
    )
) AS estimate
FROM pair_inputs i;

CREATE VIEW standing_scene AS
SELECT s.settings = b.settings AND s.inputs = b.inputs AS is_current, s.*
FROM batch_inputs b
JOIN scene s ON s.revision = coalesce(
    (SELECT c.revision FROM scene c WHERE c.batch = b.batch AND c.settings = b.settings AND c.inputs = b.inputs),
    (SELECT max(l.revision) FROM scene l WHERE l.batch = b.batch)
)
WHERE NOT EXISTS (
    SELECT 1 FROM choice c
    JOIN wanted_pair w ON w.pair = c.pair AND w.batch = s.batch
    LEFT JOIN current_points p ON p.position = w.position AND p.revision = CAST(c.inputs AS INTEGER)
    WHERE c.scene = s.revision AND p.revision IS NULL
);

-- What readers ask for, by the position of a pair.

CREATE VIEW pair_image AS
SELECT w.position, 0 AS side, i.*
FROM wanted_pair w JOIN pair ON pair.id = w.pair JOIN image i ON i.name = pair.image0
UNION ALL
SELECT w.position, 1, i.*
FROM wanted_pair w JOIN pair ON pair.id = w.pair JOIN image i ON i.name = pair.image1;

CREATE VIEW pair_state AS  -- NULL: no points, no estimate
SELECT s.position,
    (SELECT group_concat(c.number, ' ') FROM current_points c WHERE c.position = s.position) AS units,
    (SELECT sum(c.matches) FROM current_points c WHERE c.position = s.position) AS matches,
    e.F, (SELECT sum(value) FROM json_each(e.inliers)) AS inliers, e.failure,
    e.settings = s.settings AND e.inputs = s.inputs AS is_current  -- the estimate
FROM pair_standing s
LEFT JOIN estimate e ON e.revision = s.estimate;

CREATE VIEW unit_record AS
SELECT c.position, c.number, c.unit, c.stage, c.matches, coalesce(json_extract(e.inliers, '$."' || c.revision || '"'), 0) AS inliers,
    c.encode_seconds, c.match_seconds, c.failure, c.note, c.keypoints
FROM current_points c
JOIN pair_standing s ON s.position = c.position
LEFT JOIN estimate e ON e.revision = s.estimate;

CREATE VIEW region_record AS  -- of the first unit of stage 2: the other columns are those of the row with the minimum
SELECT c.position, min(c.number), r.image AS number, r.*
FROM current_points c JOIN region r ON r.points = c.revision
GROUP BY c.position, r.image;

CREATE VIEW pair_record AS  -- NULL: no estimate, no points, no failure
SELECT w.position AS "index", w.id, w.batch, ends.image0, ends.image1, ends.turns0, ends.turns1,
    coalesce(e.failure, nullif(w.failure, '')) AS failure, e.F, e.magsac, e.support, e.candidates,
    e.cost, e.magsac_cost, e.focals, e.rotation, e.seconds AS estimate_seconds, p.*
FROM wanted_pair w
JOIN pair ends ON ends.id = w.pair
JOIN pair_standing s ON s.position = w.position
LEFT JOIN estimate e ON e.revision = s.estimate
LEFT JOIN (
    SELECT position, sum(matches) AS matches, sum(decode_seconds) AS decode_seconds, sum(encode_seconds) AS encode_seconds,
        sum(match_seconds) AS match_seconds, sum(cluster_seconds) AS cluster_seconds
    FROM current_points
    GROUP BY position
) p ON p.position = w.position
WHERE w.has_row;

CREATE VIEW pair_choice AS
SELECT w.position, c.F, c.reason
FROM standing_scene s
JOIN choice c ON c.scene = s.revision
JOIN wanted_pair w ON w.pair = c.pair AND w.batch = s.batch;
